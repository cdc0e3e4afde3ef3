"""Facts about a running robot for the tools: topics, processes, logs, and why it stands still.

It may import bus, client, config, gate, geometry, host, logs, runtime and security.
Ui, commands and qa may import it.
"""
