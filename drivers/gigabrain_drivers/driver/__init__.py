"""The driver process: a body on the bus, behind the gate, over any link.

`base` and `robot` are a driver's contract and import only `links`. `catalog` finds drivers by name,
`process` runs one; both may import every room here. Authors of drivers import `base` and `robot`.
"""
