"""A stand-in for a PX4 autopilot and its UWB beacons, for tests."""
