"""Who may do what: a fleet's own authority, identities for its hosts, and the router's rules."""
