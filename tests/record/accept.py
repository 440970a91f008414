"""Shows what has changed against the reference flights, and records those anew.

Run `python -m tests.record.accept` when the pilot is meant to behave otherwise, read what it prints, and
commit the files with the change.
"""

from __future__ import annotations

from companion.recording import RecordError, read
from companion.replay import replay
from tests.record.reference import DATA, FLIGHTS, SAME_BEHAVIOUR, path_of, record


def main() -> None:
    DATA.mkdir(exist_ok=True)
    for name in FLIGHTS:
        path = path_of(name)
        if path.exists():
            try:
                before = replay(read(path))
            except RecordError as error:
                print(error)
            else:
                print(before.text())
                if before.deviation <= SAME_BEHAVIOUR and before.stopped is None:
                    continue  # nothing to accept: the file stays as it is
        path.write_bytes(record(name))
        now = replay(read(path))
        phases = ", ".join(
            f"{row.replayed.after.value} {row.replayed.t_s:.1f} s" for row in now.phases if row.replayed
        )
        print(f"{path}: recorded anew, {path.stat().st_size // 1000} kB: {phases}\n")


if __name__ == "__main__":
    main()
