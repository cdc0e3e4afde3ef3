"""The gate: decides in each tick whether, and how fast, the body may move. Pure.

It may import geometry.
The driver obeys it; safety, control and all that show its state may import it.
"""
