"""Bodies that are not there: real bytes on a pty or a TCP port, with physics behind them."""
