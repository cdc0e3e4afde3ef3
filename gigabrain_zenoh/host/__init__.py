"""The operating system: files, signals, child processes, threads, cores, memory.

It imports no other room.
Every room may import it.
"""
