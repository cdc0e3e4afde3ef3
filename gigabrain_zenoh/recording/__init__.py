"""Recording what a robot says into MCAP files ("bags"), and all that can be done with them."""

from importlib.util import find_spec

from gigabrain_zenoh.errors import ConfigError

if not (find_spec("mcap") and find_spec("foxglove")):
    raise ConfigError("recordings need more packages: pip install 'gigabrain-zenoh[record]'")
