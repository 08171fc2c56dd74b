"""Reader of arrays in Python pickles that does not execute them.

Its steps are taken here, one by one, over numbers, texts, lists and dictionaries. What it would have Python call is
looked up in a short list of what arrays are made of (numpy, sparse matrices, chumpy) and noted, never called; whatever
else it names is refused.
"""

from __future__ import annotations

import math
import pickletools
import re
from dataclasses import dataclass, field
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

_MOST_STEPS = 400_000  # opcodes; limit on time in damaged files
_MOST_AXES = 8  # limit on damaged files
_DEEPEST = 8  # nested chumpy objects
_MULTIARRAY, _NUMERIC = (
    ("numpy.core.multiarray", "numpy._core.multiarray"),
    ("numpy.core.numeric", "numpy._core.numeric"),
)
_KNOWN: Final = {
    **{(module, "_reconstruct"): "array" for module in _MULTIARRAY},
    **{(module, "scalar"): "scalar" for module in _MULTIARRAY},
    **{(module, "_frombuffer"): "buffer" for module in _NUMERIC},
    ("numpy", "ndarray"): "class",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "bytes",
    ("copy_reg", "_reconstructor"): "object",
    ("copyreg", "_reconstructor"): "object",
    ("__builtin__", "object"): "class",
    ("builtins", "object"): "class",
    **{
        (f"scipy.sparse.{module}{kind}", f"{kind}_matrix"): "class"
        for kind in ("csc", "csr", "coo")
        for module in ("", "_")
    },
}
_CHUMPY = re.compile(r"chumpy(\.\w+)*")
_DTYPE = re.compile(r"[<>|=]?([biuf][1248])")
_PLAIN = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE", "BINUNICODE",
    "SHORT_BINUNICODE", "BINUNICODE8",
}  # fmt: skip
_CONSTANTS: Final = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class PickleRefusedError(ValueError):
    """A pickle that is damaged or contains more than arrays; the text gives the reason, as a clause."""


@dataclass
class _PickledObject:
    """An object that the pickle would create: its kind from `_KNOWN`, its arguments, and its state."""

    kind: str
    parts: tuple[Any, ...] = ()
    state: Any = None


@dataclass
class _Machine:
    stack: list[Any] = field(default_factory=list[Any])
    marks: list[int] = field(default_factory=list[int])
    memo: dict[int, Any] = field(default_factory=dict[int, Any])

    def since_mark(self) -> list[Any]:
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def pop(self) -> Any:
        if self.marks and len(self.stack) <= self.marks[-1]:
            raise IndexError
        return self.stack.pop()


def pickled_dict(data: bytes) -> dict[str, Any]:
    """Return the dictionary in a pickle; pass its values to `pickled_array`.

    Raises:
        PickleRefusedError: it is none, is damaged, or names what no array needs.
    """
    machine = _Machine()
    try:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if step > _MOST_STEPS:
                raise PickleRefusedError(f"it has more than {_MOST_STEPS} steps")
            _run_step(machine, opcode.name, argument)
        content = machine.pop()
    except PickleRefusedError:
        raise
    except Exception as error:  # the parser of the standard library may raise anything at all
        raise PickleRefusedError("it is no pickle, or it is cut short") from error
    if not isinstance(content, dict):
        raise PickleRefusedError("it holds no dictionary")
    return cast(dict[str, Any], content)


def pickled_array(value: object, depth: int = 0) -> npt.NDArray[Any]:
    """Return the array that `value` of a pickle describes, also inside chumpy.

    Raises:
        PickleRefusedError: it is none of numbers, or is not as long as it says.
    """
    if isinstance(value, list) and all(type(number) in (int, float) for number in cast(list[Any], value)):
        try:
            return np.array(value, dtype=np.float64)
        except OverflowError as error:
            raise PickleRefusedError("a list in it is no array") from error
    if not isinstance(value, _PickledObject) or depth > _DEEPEST:
        raise PickleRefusedError("what should be an array is none")
    state_items, state_fields = _tuple(value.state), _dict(value.state)
    if value.kind == "array" and len(state_items) == 5:
        _, shape, dtype, fortran, data = state_items
        return _numbers(data, _dtype(dtype), shape, bool(fortran))
    if value.kind == "buffer" and len(value.parts) >= 4:
        data, dtype, shape, order = value.parts[:4]
        return _numbers(data, _dtype(dtype), shape, order == "F")
    if value.kind == "scalar" and len(value.parts) == 2:
        return _numbers(value.parts[1], _dtype(value.parts[0]), (), False)
    if value.kind == "chumpy" and "x" in state_fields:
        return pickled_array(state_fields["x"], depth + 1)
    if value.kind == "chumpy" and {"a", "idxs"} <= state_fields.keys():
        return _select_rows(state_fields, depth)
    raise PickleRefusedError("what should be an array is none")


def _select_rows(state: dict[str, Any], depth: int) -> npt.NDArray[Any]:
    """Return the elements that chumpy's Select takes from an array."""
    flat = pickled_array(state["a"], depth + 1).ravel()
    indices = pickled_array(state["idxs"], depth + 1).astype(np.int64).ravel()
    shape = state.get("preferred_shape") or (len(indices),)
    if indices.size and (indices.min() < 0 or indices.max() >= len(flat)):
        raise PickleRefusedError("it takes parts of an array that are not there")
    return flat[indices].reshape(_shape(shape, len(indices)))


def _dtype(value: object) -> np.dtype[Any]:
    kind = value.parts[0] if isinstance(value, _PickledObject) and value.kind == "dtype" and value.parts else None
    match = _DTYPE.fullmatch(kind) if isinstance(kind, str) else None
    if match is None:
        raise PickleRefusedError("an array in it is not of numbers")
    state = _tuple(cast(_PickledObject, value).state)
    is_big = len(state) > 1 and state[1] == ">"
    try:
        return np.dtype(match[1]).newbyteorder(">" if is_big or cast(str, kind)[0] == ">" else "<")
    except TypeError as error:
        raise PickleRefusedError("an array in it is not of numbers") from error


def _shape(shape: Any, count: int) -> tuple[int, ...]:
    sizes: tuple[Any, ...] = tuple(shape) if type(shape) in (tuple, list) else (-1,)
    if len(sizes) > _MOST_AXES or not all(type(size) is int and 0 <= size < 2**40 for size in sizes):
        raise PickleRefusedError("an array in it has a strange shape")
    if math.prod(sizes) != count:
        raise PickleRefusedError("an array in it is not as long as it says")
    return sizes


def _numbers(data: Any, dtype: np.dtype[Any], shape: tuple[Any, ...], fortran: bool) -> npt.NDArray[Any]:
    content = _as_bytes(data)
    if len(content) % dtype.itemsize:
        raise PickleRefusedError("an array in it is not as long as it says")
    sizes = _shape(shape, len(content) // dtype.itemsize)
    return np.frombuffer(content, dtype).reshape(sizes, order="F" if fortran else "C")


def _tuple(value: Any) -> tuple[Any, ...]:
    return cast(tuple[Any, ...], value) if isinstance(value, tuple) else ()


def _dict(value: Any) -> dict[Any, Any]:
    return cast(dict[Any, Any], value) if isinstance(value, dict) else {}


def _as_bytes(data: Any) -> bytes:
    if isinstance(data, str):  # as Python 2 wrote bytes
        return data.encode("latin-1", "replace")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    raise PickleRefusedError("an array in it holds objects")


def _run_step(machine: _Machine, name: str, argument: Any) -> None:
    """Execute one step of a pickle."""
    stack = machine.stack
    if name in _PLAIN:
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name in _TUPLES:
        stack.append(tuple(reversed([machine.pop() for _ in range(_TUPLES[name])])))
    elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
        machine.memo[len(machine.memo) if name == "MEMOIZE" else argument] = stack[-1]
    elif name in ("GET", "BINGET", "LONG_BINGET"):
        stack.append(machine.memo[argument])
    elif name in ("GLOBAL", "STACK_GLOBAL"):
        module, name_in_module = argument.split(" ", 1) if name == "GLOBAL" else (machine.pop(), machine.pop())[::-1]
        stack.append(_resolve_name(str(module), str(name_in_module)))
    elif name in ("REDUCE", "NEWOBJ"):
        arguments, function = machine.pop(), machine.pop()
        stack.append(_call(function, arguments))
    elif name == "BUILD":
        state = machine.pop()
        if not isinstance(stack[-1], _PickledObject):
            raise PickleRefusedError("it changes what is no array")
        stack[-1].state = state
    else:
        _run_container_step(machine, name)


def _run_container_step(machine: _Machine, name: str) -> None:
    stack = machine.stack
    match name:
        case "PROTO" | "FRAME" | "STOP":
            pass
        case "MARK":
            machine.marks.append(len(stack))
        case "POP_MARK":
            machine.since_mark()
        case "POP":
            machine.pop()
        case "DUP":
            stack.append(stack[-1])
        case "EMPTY_LIST":
            stack.append([])
        case "EMPTY_DICT":
            stack.append({})
        case "LIST":
            stack.append(machine.since_mark())
        case "TUPLE":
            stack.append(tuple(machine.since_mark()))
        case "DICT":
            stack.append(_items(machine.since_mark()))
        case "APPEND" | "APPENDS":
            items = [machine.pop()] if name == "APPEND" else machine.since_mark()
            _expect(stack[-1], list).extend(items)
        case "SETITEM" | "SETITEMS":
            pairs = [machine.pop(), machine.pop()][::-1] if name == "SETITEM" else machine.since_mark()
            _expect(stack[-1], dict).update(_items(pairs))
        case _:
            raise PickleRefusedError(f"it takes a step ({name}) that no array needs")


def _expect(value: Any, kind: type[Any]) -> Any:
    if type(value) is not kind:
        raise PickleRefusedError("it fills what is no list and no dictionary")
    return value


def _items(pairs: list[Any]) -> dict[Any, Any]:
    if not all(isinstance(key, str | int | bytes) for key in pairs[::2]):
        raise PickleRefusedError("it has a dictionary with strange keys")
    return dict(zip(pairs[::2], pairs[1::2], strict=True))


def _resolve_name(module: str, name: str) -> _PickledObject:
    if _CHUMPY.fullmatch(module) and name.isidentifier():
        return _PickledObject("name", ("chumpy",))
    if (module, name) not in _KNOWN:
        raise PickleRefusedError(f"it asks for {module[:40]}.{name[:40]}, which no array needs")
    return _PickledObject("name", (_KNOWN[module, name],))


def _call(function: Any, arguments: Any) -> Any:
    """Return the object that a call of `function` creates."""
    if not isinstance(function, _PickledObject) or function.kind != "name" or not isinstance(arguments, tuple):
        raise PickleRefusedError("it calls what is no name")
    values = cast(tuple[Any, ...], arguments)
    kind = function.parts[0]
    if kind == "object" and values and isinstance(values[0], _PickledObject) and values[0].kind == "name":
        return _PickledObject(values[0].parts[0])
    if kind == "bytes":
        if len(values) != 2 or not isinstance(values[0], str) or values[1] not in ("latin1", "latin-1"):
            raise PickleRefusedError("it asks for a strange text")
        return values[0].encode("latin-1", "replace")
    return _PickledObject(kind, values)
