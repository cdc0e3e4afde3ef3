"""The operator page: shows a robot in a browser, and steers it."""
