import json

import pytest

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional


def test_an_installed_module_is_imported() -> None:
    assert optional("json", "export") is json


def test_a_missing_package_is_named_with_what_installs_it() -> None:
    with pytest.raises(
        BadInputError, match=r'^no_such_package is .* pip install "astra-data\[export\]"'
    ):
        optional("no_such_package.inner", "export")
