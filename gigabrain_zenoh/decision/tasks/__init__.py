"""Goals and missions, in a queue that survives a restart.

`mission` reads behaviour trees from YAML, `behaviour_tree` carries them out by its `leaves`, and
`task_queue` keeps them. A step that moves the robot issues a command and gets its outcome back.
"""
