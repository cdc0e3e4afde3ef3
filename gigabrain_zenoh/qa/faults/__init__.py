"""Faults on purpose: chaos proxies, hostile input, and the suite that judges a robot by them."""
