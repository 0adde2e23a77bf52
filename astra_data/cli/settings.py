"""Options of commands from the models of stages' settings, read without loading the stages."""

import ast
from collections.abc import Callable, Iterator
from functools import wraps
from importlib.util import find_spec
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

_KINDS: dict[str, Any] = {
    **dict.fromkeys(("int", "Count", "AtOnce", "CountFromZero"), int),
    **dict.fromkeys(("float", "Positive", "NotNegative", "Share"), float),
    "bool": bool,
}
"""Types of settings by name, and what stands for one on the command line; else the default decides."""


class Setting(NamedTuple):
    """A field of a model: its name, its type on the command line, its default, and the text below it."""

    name: str
    kind: Any
    default: Any
    about: str


def settings_of(place: str) -> list[Setting]:
    """Return the fields of a model at "package.module:Model", as its source says.

    The module is not run: it may take seconds to load.
    """
    module, _, name = place.partition(":")
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    (model,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    return list(_settings(model))


def with_settings(place: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a command take an option for each field of a model, in the place of its parameter `settings`.

    That is then given those that were typed, by their names.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        fields = {setting.name: setting for setting in settings_of(place)}

        @wraps(command)
        def run(**given: Any) -> None:  # noqa: ANN401 - of any option
            typed = {name: value for name in fields if (value := given.pop(name)) is not None}
            command(settings=typed, **given)

        parameters: list[Parameter] = []
        for parameter in signature(command).parameters.values():
            is_theirs = parameter.name == "settings"
            parameters += map(_option, fields.values()) if is_theirs else [parameter]
        run.__dict__.pop("__wrapped__")
        run.__dict__["__signature__"] = Signature(parameters)
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorated


def _settings(model: ast.ClassDef) -> Iterator[Setting]:
    texts: list[Any] = [*model.body[1:], None]
    for node, after in zip(model.body, texts, strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        value = node.value
        if isinstance(value, ast.Call):
            value = next(keyword.value for keyword in value.keywords if keyword.arg == "default")
        assert value is not None
        default = ast.literal_eval(value)
        match after:
            case ast.Expr(value=ast.Constant(value=str() as text)):
                about = " ".join(text.split())
            case _:
                about = ""
        yield Setting(node.target.id, _kind(node.annotation, default), default, about)


def _kind(annotation: ast.expr, default: object) -> Any:  # noqa: ANN401 - a type
    """Return the type of an option for values of an annotation such as `Count | None`."""
    names = (node.id for node in ast.walk(annotation) if isinstance(node, ast.Name))
    kind = next((_KINDS[name] for name in names if name in _KINDS), str)
    return tuple[float, float] if isinstance(default, tuple) else kind


def _option(setting: Setting) -> Parameter:
    dashed, default = setting.name.replace("_", "-"), setting.default
    shown: Any = False if default is None else str(default)
    names: list[str] = []
    if isinstance(default, bool):
        names = [f"--{dashed}/--no-{dashed}"]
        shown = dashed if default else f"no-{dashed}"
    metavar = "LEAST LARGEST" if isinstance(default, tuple) else None
    if isinstance(default, tuple):
        shown = " ".join(f"{end:g}" for end in default)
    about = setting.about.replace("`", "")
    option = typer.Option(*names, help=about, show_default=shown, metavar=metavar)
    annotation: Any = Annotated[setting.kind | None, option]
    return Parameter(setting.name, Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
