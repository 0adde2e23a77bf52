"""The command line, called in the process of a test."""

from typer.testing import CliRunner, Result

from astra_data.cli.app import app


def call(*words: str) -> Result:
    """Call `astra-data WORDS`; the result holds the exception that ended it, if any."""
    return CliRunner().invoke(app, words)


def output_of(*words: str) -> str:
    """Return what `astra-data WORDS` prints on stdout; any error is one of the test."""
    result = CliRunner().invoke(app, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout
