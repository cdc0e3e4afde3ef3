"""The `gigabrain` command. Each group of commands is a module, imported when it is used.

It may import everything, the drivers included.
Nothing imports it.
"""
