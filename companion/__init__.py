"""Fly a drone to a target, or hold it at a station, from nothing but distances."""
