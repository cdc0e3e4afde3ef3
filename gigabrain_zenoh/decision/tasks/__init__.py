"""Goals and missions, in a queue that survives a restart.

`mission` defines the files, `behaviour_tree` and `leaves` execute them, and `task_queue` keeps
them. A step that moves the robot issues a command and gets its outcome back.
"""
