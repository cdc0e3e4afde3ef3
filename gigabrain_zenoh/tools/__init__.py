"""Tools that look at a running robot: topics, processes, why it does not move, what it logs."""
