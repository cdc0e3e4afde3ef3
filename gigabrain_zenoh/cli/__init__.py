"""The `gigabrain` command. Each group of commands is a module that is imported when it is used."""
