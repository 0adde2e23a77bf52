"""The exceptions that the toolkit raises; all expected ones are AstraDataErrors."""

from astra_data.core.naming import printable, shortened


class AstraDataError(Exception):
    """Any expected error; the command line prints one line, without a traceback, and exits with 1."""


class BadInputError(AstraDataError):
    """A value, file or column is not what was expected."""


class RecipeError(AstraDataError):
    """A recipe is missing, malformed or contradicts itself."""


class MissingStageError(AstraDataError):
    """An earlier stage has not been run yet; the message names the command that runs it."""


class CorruptDatasetError(AstraDataError):
    """A dataset on disk is incomplete or was altered."""


class SharingError(AstraDataError):
    """A remote storage cannot be reached, refuses, or holds something else."""


class DiskError(AstraDataError):
    """A disk is full, read-only, failing or gone; the message names the file and what to do."""


_LONGEST = 300  # characters of an error message of a library that are shown


def in_short(error: Exception) -> str:
    """Return the first sentence of an error message, of bounded length and printable."""
    line = str(error).split("\n")[0].split(". ")[0].rstrip(".:")
    return shortened(printable(line), _LONGEST)
