"""A job that is stopped midway, as if it had been killed."""

from astra_data.core.progress import Progress


class Stopped(Exception):  # noqa: N818 - stands for a kill
    """What a job ends with that is stopped."""


def stop_past(share: float) -> Progress:
    """Return a job's progress callback that stops it once more than `share` is done."""

    def progress(fraction: float, note: str) -> None:
        if fraction > share:
            raise Stopped

    return progress
