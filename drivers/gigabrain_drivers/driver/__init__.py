"""The driver process: a body on the bus, behind the gate, whatever its wire."""
