"""The flying loop with its two links and nothing beside it: no record, no status, no view.

python -m companion.bench.system.bare capture.toml
"""

from __future__ import annotations

import sys
from collections import deque
from pathlib import Path

from companion import config
from companion.compiled import twin
from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell, Loop


def main(path: Path) -> None:
    """Fly until killed."""
    settings = config.load(path, {}, []).config
    bell = twin(Bell)()
    vehicle = twin(VehicleLink).open(settings.vehicle)
    ranges = twin(RangeLink)(settings.ranges, bell.ring, settings.beacons)
    nowhere = deque[object](maxlen=0).append  # not a lambda: that would be the only Python on a range's way
    twin(Loop)(settings, vehicle, ranges, bell, nowhere, nowhere).fly()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
