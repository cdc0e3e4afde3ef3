"""Trains the shipped recogniser: pictures drawn by MuJoCo, a small net, its export and its scores.

Started as `python -m gigabrain_zenoh.qa.train`; needs the extra `train`.
May import `vision`, the drivers' models and all rooms below; nothing imports it.
"""
