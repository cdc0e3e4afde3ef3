"""Trains the shipped recogniser: rendered pictures, a small net, its export and its scores.

Run it as `python -m gigabrain_zenoh.qa.train`; it needs the extra `train`.
It may import `vision`, the drivers' models and all rooms below; nothing imports it.
"""

import os

# TensorFlow needs it to train dilated convolutions; only newer processors have it by default
os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "1")
