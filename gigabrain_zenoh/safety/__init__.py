"""Safety: listens to all, trusts none, and says whether and how fast the body may move.

One file for each thing that it looks after; `step` puts them side by side, `node` is the process.
"""
