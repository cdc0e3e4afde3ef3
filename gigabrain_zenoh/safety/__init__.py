"""Safety: listens to all, trusts none, and says whether and how fast the body may move.

One file for each thing that it looks after; `step` puts them side by side, `run` is the process.
"""

from gigabrain_zenoh.safety.node import run as run
from gigabrain_zenoh.safety.step import Inputs as Inputs
from gigabrain_zenoh.safety.step import Memory as Memory
from gigabrain_zenoh.safety.step import step as step
