"""The operator page: a robot in a browser, seen and steered."""
