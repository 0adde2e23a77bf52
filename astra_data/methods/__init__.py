"""All methods by name; each file defines one method, or a family of them. Those of the user's are added."""

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import get_args

from astra_data.core.config import Config, did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import PLUS, base_method, is_plus
from astra_data.grounding.files import kinds
from astra_data.grounding.fit import HistoryFit
from astra_data.methods import astra, follower, iql
from astra_data.methods.method import Method, Role, Source, Table
from astra_data.methods.rma import RMA
from astra_data.policies.learner import add_policy_kind
from astra_data.policies.simulator_env import RewardSource
from astra_data.policies.train import InSimulator, UserLearner
from astra_data.worlds.user_code import offered, user_object

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        astra.DIRECT_TRANSFER,
        astra.DOMAIN_RANDOMIZATION,
        astra.NAS,
        RMA,
        astra.TARGET,
        astra.FULL_OBS,
        astra.COMPASS,
        iql.IQL,
        iql.BEHAVIOR_CLONING,
        iql.DIRECT_TRANSFER_IQL,
        astra.ASTRA,
        *astra.ABLATIONS,
        follower.FOLLOWER,
    )
}  # by name. Recipes list the methods' tables, and results the settings in them, in this order.

ENTRY_POINTS = "astra_data.methods"  # the group of entry points under which installed packages offer methods
_NAME, _COLOR = re.compile("[a-z][a-z0-9_]*"), re.compile("#[0-9a-fA-F]{6}")
_PLACES: dict[str, str] = {}
"""Where the methods come from that are none of the package's, by name; in this process each name is one."""


def add_method(name: str, place: str) -> None:
    """Add a method of the user's at "file.py:METHOD" or "package.module:METHOD" to `METHODS`; its code is run."""
    file, is_file, attribute = place.partition(".py:")
    found = f"{Path(f'{file}.py').resolve()}:{attribute}" if is_file else place
    if (known := _PLACES.get(name)) == found:
        return
    if known is not None:
        raise BadInputError(f"method '{name}' is {known} already: give {place} another name")
    if not _NAME.fullmatch(name) or is_plus(name):
        raise BadInputError(
            f"method '{name}': expected a name of a-z, 0-9 and _ that does not end in {PLUS} and begins with a letter"
        )
    if is_of_package(name):
        raise BadInputError(f"method '{name}' is one of the package: give {place} another name")
    method = user_object(place)
    if not isinstance(method, Method):
        raise BadInputError(f"{place} is a {type(method).__name__}, expected a Method")
    if faults := [*_faults(method)]:
        raise BadInputError("; ".join(f"{place} {fault}" for fault in faults))
    if (kind := method.grounding) and (owner := kinds().setdefault(kind.kind, kind)) is not kind:
        whose = f"{owner.__name__} in {sys.modules[owner.__module__].__file__}"
        raise BadInputError(f"{place}: groundings of kind '{kind.kind}' are those of {whose}: rename its kind")
    if isinstance(method.fit, HistoryFit) and (encoder := method.fit.encoder):
        from astra_data.grounding.encoder import ENCODERS

        if ENCODERS.setdefault(encoder.kind, encoder) is not encoder:
            raise BadInputError(f"{place}: there are encoders of kind '{encoder.kind}' already: rename its kind")
    if isinstance(method.learn, UserLearner):
        add_policy_kind(method.learn.policy)
    METHODS[name] = replace(method, name=name)
    _PLACES[name] = found


def _faults(method: Method) -> Iterator[str]:
    """Yield what a method of the user's lacks to be a row."""
    if method.color and not _COLOR.fullmatch(str(method.color)):
        yield f'has the color {method.color!r}: expected "#rrggbb"'
    choices = {"role": (None, *get_args(Role)), "learns_from": get_args(Source), "configures": ("ground", "train")}
    choices |= {"reward": get_args(RewardSource), "ranges": (None, "randomized", "wide")}
    values = vars(method) | (vars(method.learn) if isinstance(method.learn, InSimulator) else {})
    for name, known in choices.items():
        if (value := values.get(name, known[0])) not in known:
            yield f"has {name}={value!r}: expected {', '.join(map(repr, known))}"
    if not isinstance(method.title, str):
        yield f"has title={method.title!r}: expected text"
    table, grounding, learn = method.table, method.grounding, method.learn
    functions: dict[str, tuple[Callable[..., object] | None, str]] = {"fit": (method.fit, "fitting")}
    functions["learn"] = (learn.learn, "env, training") if isinstance(learn, UserLearner) else (learn, "training")
    for name, (function, given) in functions.items():
        if function is not None and not _takes(function, given.split()):
            yield f"has {name}={function!r}: expected a function {name}({given})"
    if table is not None and not isinstance(table, Table):
        yield f"has table={table!r}: expected a Table of its name in recipes and the class of its settings"
        return
    policy = learn.policy if isinstance(learn, UserLearner) else None
    encoder = method.fit.encoder if isinstance(method.fit, HistoryFit) else None
    classes = {"grounding": grounding, "policy": policy, "encoder": encoder, "table": table and table.model}
    if objects := [name for name, made in classes.items() if made is not None and not isinstance(made, type)]:
        yield f"has an object as {', '.join(objects)}: expected its class"
        return
    if encoder and (missing := _missing(encoder, "initial", "step", "latent", "sequence")):
        yield f"has an encoder, {encoder.__name__}, without {missing}: expected a subclass of Encoder"
    if learn is None:
        yield "learns no policy: expected learn, an UserLearner that returns one"
    elif policy and (missing := _missing(policy, "to_file", "from_file", "act")):
        yield f"learns a {policy.__name__}, without {missing}: expected the class of what learn returns"
    used = [name for name in ("grounding", "aligns", "grounded_as") if getattr(method, name)]
    if used and method.fit is None:
        yield f"has {', '.join(used)}, and nothing is fitted: expected fit"
    elif method.grounded_as in METHODS and METHODS[method.grounded_as].fit != method.fit:
        yield f"is grounded as {method.grounded_as}, which has another fit: expected the same"
    if isinstance(method.fit, HistoryFit) and values.get("reward") == "predicted" and not method.fit.reward:
        yield "is paid a reward that nothing predicts: expected HistoryFit(reward=True)"
    if grounding and (missing := _missing(grounding, "to_file", "from_file", "corrected", "simulator")):
        yield f"has a grounding, {grounding.__name__}, without {missing}: expected a subclass of FittedGrounding"
    if table is None:
        return
    if not issubclass(table.model, Config):
        name = table.model.__name__
        yield f"has settings of {name}, which is no astra_data.core.config.Config: expected class {name}(Config)"
    elif method.configures == "ground" and method.fit is None:
        yield 'has settings that nothing reads: configures="ground" needs fit'
    elif method.configures == "train" and type(method.learn) is InSimulator:
        yield 'has settings that nothing reads: expected configures="ground" if they are those of fit'


def _takes(function: Callable[..., object], given: Sequence[str]) -> bool:
    """Return whether `function` can be called with as many arguments; what is built in does not tell."""
    try:
        signature(function).bind(*given)
    except TypeError:
        return False
    except ValueError:
        return True
    return True


def _missing(made: type, *needed: str) -> str:
    """Return what a class lacks of a kind and of the methods `needed`."""
    abstract = getattr(made, "__abstractmethods__", ())
    missing = [one for one in needed if one in abstract or not hasattr(made, one)]
    return ", ".join(missing if isinstance(getattr(made, "kind", None), str) else ["kind, a string", *missing])


def is_of_package(name: str) -> bool:
    """Return whether a method is one of the package, not of the user's."""
    return name in METHODS and name not in _PLACES


def offered_methods() -> dict[str, str]:
    """Return the places of the methods that installed packages offer, by name."""
    return offered(ENTRY_POINTS)


def tables() -> dict[str, Table]:
    """Return every table of a recipe that methods read, by its name."""
    return {method.table.name: method.table for method in METHODS.values() if method.table}


def method_role(row: str) -> str | None:
    """Return what a row is to the others, if it is something."""
    return METHODS[row].role if row in METHODS else None


def method_title(row: str) -> str:
    """Return the title of a row: "astra_plus" is "ASTRA+"."""
    base = base_method(row)
    title = METHODS[base].title if base in METHODS else base.replace("_", " ").capitalize()
    return f"{title}+" if is_plus(row) else title


def method_named(row: str) -> Method:
    """Return the method of a row: `astra` for "astra" and for "astra_plus"."""
    name = base_method(row)
    if name not in METHODS and (place := offered_methods().get(name)):
        add_method(name, place)
    if name not in METHODS:
        raise BadInputError(f"unknown method '{row}'{did_you_mean(name, METHODS)}")
    return METHODS[name]


def grounded_as(row: str) -> str:
    """Return the method whose grounding and alignment a row uses."""
    return method_named(row).grounded_as or base_method(row)
