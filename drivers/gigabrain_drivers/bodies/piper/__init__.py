"""AgileX Piper, an arm of six joints and a gripper on CAN: driver, protocol and emulator."""
