"""Bodies on four legs: their geometry, how they walk, and where their legs have carried them."""
