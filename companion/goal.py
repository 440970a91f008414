"""Where the simulated world puts the goal of a mission: what a simulated flight is judged by."""

from __future__ import annotations

import math

from companion.config import Config, ConfigError
from companion.guidance import station_fit, station_search

CONTRADICTION_M = 0.1
"""The station's distances may miss those to the simulated beacons by this much."""


def true_goal(config: Config) -> tuple[float, float]:
    """The target, or the station, in the simulated world: metres East and North.

    Raises ConfigError where `[sim]` lacks a beacon, or where no place has the distances of the station.
    """
    at = {beacon.id: (beacon.x_m, beacon.y_m) for beacon in config.sim.beacons}
    there = f"[sim] has {', '.join(at)}"
    if config.mission.kind == "capture":
        target = config.mission.target
        if target not in at:
            raise ConfigError(f"mission.target = {target!r}: no such beacon; {there}")
        return at[target]
    known = {name: b.station_distance_m for name, b in config.beacons.items() if name in at}
    distances_m = {name: d for name, d in known.items() if d is not None}
    if len(distances_m) < len(config.beacons):
        missing = ", ".join(name for name in config.beacons if name not in distances_m)
        raise ConfigError(f"sim.beacons: {missing} of [beacons] missing; {there}")
    places, distances = [at[name] for name in distances_m], list(distances_m.values())
    found = [
        station_fit.closest(x, y, places, distances, [1.0] * len(places))
        for x, y in station_search.stations(places, distances)
    ]
    misses = [[math.dist(p, b) - d for b, d in zip(places, distances, strict=True)] for p in found]
    worst = [max(map(abs, miss)) for miss in misses]
    best = worst.index(min(worst))
    if worst[best] > CONTRADICTION_M:
        name = list(distances_m)[[abs(m) for m in misses[best]].index(worst[best])]
        raise ConfigError(
            f"beacons.{name}.station_distance_m = {distances_m[name]:g}: no place has these distances from "
            f"the beacons of [sim]; the nearest, ({found[best][0]:.2f}, {found[best][1]:.2f}), is "
            f"{math.dist(found[best], at[name]):.2f} m from {name}"
        )
    return found[best]
