"""Goals and missions, in a queue that survives a restart.

`mission` reads behaviour trees from YAML, `behaviour_tree` carries them out, and `task_queue` keeps
them. A step that drives issues a DriveCommand and gets its outcome back.
"""
