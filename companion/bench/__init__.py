"""Design and measurement on the desk; never imported by the flying process."""
