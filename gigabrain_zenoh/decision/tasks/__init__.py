"""What the robot is sent to do: goals and missions, in a queue that survives a restart.

`mission` reads behaviour trees from YAML, `nodes` carries them out, `executive` holds the queue,
`store` remembers it, and `service` joins all that to the bus. Nothing here knows how to drive: a
step that wants the robot somewhere gives an order, and hears what became of it (`orders`).
"""
