"""Read the config.yml of a nerfstudio run as data: whoever wrote the file decides nothing about what runs here.

nerfstudio writes its configuration as YAML whose tags name Python classes, and its own reader imports and calls what they name.
Here a tag is no more than the name of a record: nothing is imported, and nothing is called but `pathlib.Path`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from pgsd_nerfstudio.scene.scene import SceneError

MOST_BYTES = 1_000_000  # a config.yml has about 10 kB; YAML of this size is read in some ten seconds
PATHS = {"PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath", "Path"}


class Record(dict[str, Any]):
    """The fields of a Python object by name, and which class the file says it is of."""

    def __init__(self, python: str, fields: dict[str, Any]) -> None:
        super().__init__(fields)
        self.python = python
        """Full name of the class, function or object, such as nerfstudio.engine.trainer.TrainerConfig."""


def read_run_config(path: Path) -> Record:
    """The config.yml of a run.

    What was a Python object is a `Record` of its fields. An object that the file makes by a call, such as a member of an
    enumeration, is a `Record` whose only field `arguments` lists them. A class or function is an empty `Record`. Paths and
    tuples stay such.

    Args:
        path: the file.

    Raises:
        SceneError: it cannot be read, is no YAML, or is not the configuration of a run.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES + 1)
        if len(text) > MOST_BYTES:
            raise SceneError(f"{path} is no config.yml of nerfstudio: it is longer than {MOST_BYTES:,} bytes")
        config = yaml.load(text.decode("utf-8"), Loader=_RunConfigReader)
    except RecursionError as error:
        raise SceneError(f"{path} is no config.yml of nerfstudio: it is nested too deeply") from error
    # Beside its own errors, yaml lets those of int(), float() and dates pass.
    except (OSError, yaml.YAMLError, ValueError, AttributeError, TypeError, OverflowError) as error:
        if isinstance(error, SceneError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{path} cannot be read as the config.yml of a run ({reason}): pass data= instead") from error
    if not isinstance(config, Record) or not config:
        raise SceneError(f"{path} is not the config.yml of a run: expected an object of nerfstudio, found something else")
    return config


def entry(config: Any, *names: str) -> Any:
    """The value at a place such as "pipeline", "model", "rasterize_mode"; None where the file has no such place.

    Args:
        config: what `read_run_config` returned, or a part of it.
        names: of the fields, from the outside inwards.
    """
    for name in names:
        config = config.get(name) if isinstance(config, dict) else None
    return config


class _RunConfigReader(yaml.SafeLoader):
    """SafeLoader, which knows plain values only, and Python's tags as records."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merges of mappings (`<<`), which nerfstudio never writes, can make a short file endless."""
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise yaml.constructor.ConstructorError(None, None, "merged mappings are not read", node.start_mark)


def _object(reader: _RunConfigReader, name: str, node: yaml.Node) -> Record:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, f"{name} has no fields", node.start_mark)
    fields = reader.construct_mapping(node, deep=True)
    return Record(name, {str(key): value for key, value in fields.items()})


def _called(reader: _RunConfigReader, name: str, node: yaml.Node) -> Path | Record:
    if isinstance(node, yaml.SequenceNode):
        arguments = reader.construct_sequence(node, deep=True)
    elif isinstance(node, yaml.MappingNode):
        fields = reader.construct_mapping(node, deep=True)
        return Record(name, {str(key): value for key, value in fields.items()})
    else:
        arguments = [reader.construct_scalar(node)]  # type: ignore[arg-type]
    module, _, kind = name.rpartition(".")
    if module.split(".")[0] == "pathlib" and kind in PATHS and all(isinstance(part, str) for part in arguments):
        return Path(*arguments)
    return Record(name, {"arguments": arguments})


def _named(reader: _RunConfigReader, name: str, node: yaml.Node) -> Record:
    return Record(name, {})


def _tuple(reader: _RunConfigReader, node: yaml.Node) -> tuple[Any, ...]:
    return tuple(reader.construct_sequence(node, deep=True))  # type: ignore[arg-type]


def _learn() -> None:
    tag = "tag:yaml.org,2002:python/"
    kinds: dict[str, Callable[..., Any]] = {"object": _object, "object/apply": _called, "object/new": _called}
    for kind, construct in {**kinds, "name": _named, "module": _named}.items():
        _RunConfigReader.add_multi_constructor(f"{tag}{kind}:", construct)
    _RunConfigReader.add_constructor(f"{tag}tuple", _tuple)
    # As PyYAML writes values of Python whose plain form it would read as something else.
    for kind, plain in {"str": "str", "unicode": "str", "int": "int", "long": "int", "float": "float", "bool": "bool"}.items():
        _RunConfigReader.add_constructor(f"{tag}{kind}", getattr(yaml.SafeLoader, f"construct_yaml_{plain}"))
    for kind, plain in {"list": "seq", "dict": "map", "none": "null"}.items():
        _RunConfigReader.add_constructor(f"{tag}{kind}", getattr(yaml.SafeLoader, f"construct_yaml_{plain}"))


_learn()
