"""Tests of the guidance mathematics, and a small plant to fly it on."""
