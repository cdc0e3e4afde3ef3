"""Bags, which are MCAP files: records, reads, plays, converts and replays them.

It may import bus, config, gate, geometry, host, logs, runtime and safety.
Diagnostics, ui, launch, commands and qa may import it.
"""

from importlib.util import find_spec

from gigabrain_zenoh.errors import ConfigError

if not (find_spec("mcap") and find_spec("foxglove")):
    raise ConfigError("recordings need more packages: pip install 'gigabrain-zenoh[record]'")
