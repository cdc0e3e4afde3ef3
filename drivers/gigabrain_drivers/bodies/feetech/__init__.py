"""Arms on a bus of Feetech STS servos: driver, protocol, calibration and emulator."""
