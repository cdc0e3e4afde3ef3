"""Operator page: shows a robot in a browser, and steers it."""
