"""The mathematics: no I/O, no clock, no global state, plain floats."""
