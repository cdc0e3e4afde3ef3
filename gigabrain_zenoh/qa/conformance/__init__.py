"""The driver author's kit: checks that every driver must pass, and templates for a new one."""
