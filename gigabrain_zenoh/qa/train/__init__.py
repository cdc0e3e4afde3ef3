"""Trains the shipped recogniser: pictures drawn by MuJoCo, a small net, its export and its scores.

Started as `python -m gigabrain_zenoh.qa.train`; needs the extra `train`.
May import `vision`, the drivers' models and all rooms below; nothing imports it.
"""

import os

# without it TensorFlow learns no dilated convolution; it is on by default on newer processors only
os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "1")
