"""Wire protocols: pure encoders and incremental decoders, without I/O and without a clock."""
