"""The fault matrix: every fault × every phase in which it may strike, and what must come of it."""
