"""All methods by name; each file defines one method, or a family of them."""

from astra_data.core.errors import BadInputError
from astra_data.core.naming import PLUS, base_method, is_plus
from astra_data.methods.astra import ASTRA, ASTRA_TASK_REWARD, ASTRA_WITHOUT_LATENT, ASTRA_WITHOUT_REWARD
from astra_data.methods.compass import COMPASS, COMPASS_UNIFORM
from astra_data.methods.direct_transfer import DIRECT_TRANSFER
from astra_data.methods.domain_randomization import DOMAIN_RANDOMIZATION
from astra_data.methods.follower import FOLLOWER
from astra_data.methods.iql import BEHAVIOR_CLONING, DIRECT_TRANSFER_IQL, IQL
from astra_data.methods.method import Method, Table
from astra_data.methods.nas import NAS
from astra_data.methods.nas_golemo import NAS_GOLEMO
from astra_data.methods.rma import RMA
from astra_data.methods.target import FULL_OBS, TARGET

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        DIRECT_TRANSFER,
        DOMAIN_RANDOMIZATION,
        NAS,
        NAS_GOLEMO,
        RMA,
        TARGET,
        FULL_OBS,
        COMPASS,
        COMPASS_UNIFORM,
        IQL,
        BEHAVIOR_CLONING,
        DIRECT_TRANSFER_IQL,
        ASTRA,
        ASTRA_WITHOUT_LATENT,
        ASTRA_WITHOUT_REWARD,
        ASTRA_TASK_REWARD,
        FOLLOWER,
    )
}
"""By name. Recipes list the methods' tables, and results the settings in them, in this order."""


def tables() -> dict[str, Table]:
    """Return every table of a recipe that methods read, by its name."""
    return {method.table.name: method.table for method in METHODS.values() if method.table}


ROLES: dict[str, str] = {name: method.role for name, method in METHODS.items() if method.role}
"""What some rows are to the others."""


def method_title(row: str) -> str:
    """Return the title of a row: "astra_plus" is "ASTRA+"."""
    base = base_method(row)
    title = METHODS[base].title if base in METHODS else base.replace("_", " ").capitalize()
    return f"{title}+" if is_plus(row) else title


def method_named(row: str) -> Method:
    """Return the method of a row: `astra` for "astra" and for "astra_plus".

    Raises:
        BadInputError: there is no such method.
    """
    name = base_method(row)
    if name not in METHODS:
        raise BadInputError(f"unknown method '{row}'; known: {', '.join(METHODS)}, each also with {PLUS}")
    return METHODS[name]
