"""What can go wrong, in one tree.

AstraDataError          anything the toolkit reports on purpose: one clear line, exit code 1
├── BadInputError       a value, file or column is not what was expected
├── RecipeError         a recipe does not say what it should
├── MissingStageError   an earlier stage has not been run yet
├── CorruptDatasetError a dataset on disk is incomplete or was altered
└── SharingError        a place where datasets are shared cannot be reached, refuses, or holds something else
"""


class AstraDataError(Exception):
    """Anything that the toolkit reports on purpose; the command line prints it without a traceback."""


class BadInputError(AstraDataError):
    """A value, file or column is not what was expected."""


class RecipeError(AstraDataError):
    """A recipe does not say what it should."""


class MissingStageError(AstraDataError):
    """An earlier stage has not been run yet; the message names the command that runs it."""


class CorruptDatasetError(AstraDataError):
    """A dataset on disk is incomplete or was altered."""


class SharingError(AstraDataError):
    """A place where datasets are shared cannot be reached, refuses, or holds something else."""
