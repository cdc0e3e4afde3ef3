"""What the tools compute about a running robot: topics, processes, logs, why it stands still.

It may import bus, client, config, gate, geometry, host, runtime and security.
Ui, commands and qa may import it.
"""
