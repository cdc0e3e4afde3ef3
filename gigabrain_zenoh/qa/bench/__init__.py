"""The benchmarks of `gigabrain bench`. They start robots or call libraries; `cli` uses them."""
