"""Packages that take seconds to load, which they do with their first use: mistakes are answered before."""

from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import TYPE_CHECKING, Any

from astra_data.core.errors import optional


class _Lazy(ModuleType):
    """A module that is loaded when something in it is first asked for."""

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever is in it
        found = getattr(optional(self.__name__), name)
        setattr(self, name, found)
        return found


if TYPE_CHECKING:
    import gymnasium as gymnasium
    import mujoco as mujoco
    import scipy as scipy
    import torch as torch
    from torch import Tensor as Tensor
else:
    gymnasium, mujoco, scipy, torch = map(_Lazy, ("gymnasium", "mujoco", "scipy", "torch"))
    Tensor = Any  # annotations are evaluated


def without_gradients[**Given, Found](function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Let `function` record nothing for gradients; `torch.no_grad` itself would load torch here."""

    @wraps(function)
    def called(*args: Given.args, **kwargs: Given.kwargs) -> Found:
        with torch.no_grad():
            return function(*args, **kwargs)

    return called
