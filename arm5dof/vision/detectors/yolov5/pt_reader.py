"""PyTorch's `.pt` files read without PyTorch, and without running anything that they say.

Such a file is a zip: `<root>/data.pkl`, a pickle of the object saved, and `<root>/data/<key>`, the raw numbers of its
tensors. A pickle is a program that may import and call whatever it likes. Here it can name a fixed list of classes
only, every one of which is an empty shell that keeps what it is given.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from arm5dof.errors import UserError

OPCODES = frozenset(
    """PROTO STOP MARK GLOBAL REDUCE BUILD NEWOBJ BINPERSID BINGET LONG_BINGET BINPUT LONG_BINPUT EMPTY_TUPLE TUPLE
    TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS NONE NEWTRUE NEWFALSE BININT BININT1
    BININT2 LONG1 BINFLOAT BINUNICODE""".split()  # noqa: SIM905
)
"""All that PyTorch writes (pickle protocol 2)."""

MAX_PICKLE = 64 * 2**20
"""Bytes of `data.pkl`; that of the largest YOLOv5 is below one megabyte."""

MAX_TUPLES = 50_000
"""Tuples in it; YOLOv5n has 2,000. A million, one inside another, would overflow the interpreter's stack."""

DTYPES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}
"""What PyTorch's storages hold, little-endian."""

MODULES = ("models.", "torch.nn.modules.")
"""Modules whose classes become shells."""

IGNORED = frozenset(
    (module, name)
    for modules, names in (
        (("numpy.core.multiarray", "numpy._core.multiarray"), ("scalar", "_reconstruct")),  # Before NumPy 2, and since.
        (("numpy",), ("ndarray", "dtype")),
        (("_codecs",), ("encode",)),
        (("pathlib", "pathlib._local"), ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath")),
        (("argparse",), ("Namespace",)),
        (("torch",), ("Size", "device")),
    )
    for module in modules
    for name in names
)
"""Names in files with the training's records: they are accepted, and what they would make is not made."""


class _Inert(type):
    """A class that the pickle can name and nothing can change."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise pickle.UnpicklingError(f"it changes the class {cls.__name__}")


class Module(metaclass=_Inert):
    """An `nn.Module` as found in the file: the name of its class and its attributes."""

    kind = ""
    """Module and class, as in `models.common.Conv`."""
    _attributes: dict[str, Any]

    def __new__(cls, *arguments: object) -> Module:
        if arguments:
            raise pickle.UnpicklingError(f"it calls {cls.kind}")
        return object.__new__(cls)

    def __setstate__(self, state: object) -> None:
        if type(state) is not dict or not all(type(key) is str for key in state):
            raise pickle.UnpicklingError(f"the attributes of {self.kind} are not a dict")
        self.__dict__["_attributes"] = state

    def get(self, name: str) -> Any:
        """An attribute, parameter, buffer or submodule; tensors as arrays. Raises `UserError` if there is none."""
        attributes = self.__dict__.get("_attributes", {})
        for place in (attributes, *(attributes.get(key) for key in ("_parameters", "_buffers", "_modules"))):
            if isinstance(place, dict) and name in place:
                value = place[name]
                return value.array if isinstance(value, Tensor) else value
        raise UserError(f"the file's {self.kind} has no {name!r}: give a file saved by the published YOLOv5 v6 code")

    def has(self, name: str) -> bool:
        """Whether there is a submodule of that name."""
        submodules = self.__dict__.get("_attributes", {}).get("_modules")
        return isinstance(submodules, dict) and name in submodules

    def children(self) -> list[Any]:
        """The submodules in order."""
        return list(self.get("_modules").values())


class Tensor(metaclass=_Inert):
    """Stands for PyTorch's function that builds a tensor from its storage."""

    array: np.ndarray

    def __new__(cls, storage: Any, offset: Any, size: Any, stride: Any, *_: object) -> Tensor:
        tensor = object.__new__(cls)
        tensor.__dict__["array"] = _view(storage, offset, size, stride)
        return tensor

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("it changes a tensor")


class _Parameter(metaclass=_Inert):
    """Stands for PyTorch's function that makes a parameter of a tensor; the tensor is what comes of it."""

    def __new__(cls, tensor: object, *_: object) -> Any:
        if not isinstance(tensor, Tensor):
            raise pickle.UnpicklingError("a parameter is not a tensor")
        return tensor


class _Storage(metaclass=_Inert):
    """Numbers of one type, (numel,). The archive has them; the pickle cannot make any."""

    dtype: type
    array: np.ndarray

    def __new__(cls, *_: object) -> Any:
        raise pickle.UnpicklingError("it makes a storage of its own")

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("it changes a storage")


class _Ignored(metaclass=_Inert):
    """Stands for what training leaves in a file and no network needs."""

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass


def read_pt(path: str | Path) -> Any:
    """Read the object in a `.pt` file, as PyTorch 1.6 and later write it.

    Returns:
        Dicts, lists, numbers, `Tensor`s and `Module`s.

    Raises:
        UserError: The file is missing, not PyTorch's, damaged, or names a class or function outside the list.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"no file {path}: give a PyTorch .pt file")
    try:
        with zipfile.ZipFile(path) as archive:
            return _Unpickler(archive).load()
    except UserError:
        raise
    except zipfile.BadZipFile:
        raise UserError(
            f"{path} is not a PyTorch file, or is cut short: expected a .pt as PyTorch 1.6 and later write it"
        ) from None
    except pickle.UnpicklingError as error:
        raise UserError(f"{path} is refused, nothing of it was run: {error}") from None
    except Exception as error:  # A damaged pickle can raise anything at all.
        raise UserError(f"{path} is damaged ({type(error).__name__}: {error}): download it again") from None


class _Unpickler(pickle.Unpickler):
    """Unpickles `data.pkl` of an archive and takes tensors from its other records."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self._records = {record.filename: record for record in archive.infolist()}
        names = [name for name in self._records if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(names) != 1:
            raise pickle.UnpicklingError("the archive holds no PyTorch object (no data.pkl)")
        self._root = names[0].removesuffix("data.pkl")
        if self._root + "byteorder" in self._records and self._read(self._root + "byteorder", 16) != b"little":
            raise pickle.UnpicklingError("its numbers are big-endian: save it again on a usual machine")
        self._classes: dict[tuple[str, str], type] = {}
        self._storages: dict[str, _Storage] = {}
        text = self._read(names[0], MAX_PICKLE)
        _check_opcodes(text)
        super().__init__(io.BytesIO(text))

    def find_class(self, module: str, name: str) -> Any:
        """An empty shell for each name on the list, made for this file alone."""
        if (module, name) not in self._classes:
            self._classes[module, name] = _shell(module, name)
        return self._classes[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        """The storage that a `("storage", type, key, location, numel)` stands for."""
        if type(pid) is not tuple or len(pid) != 5 or pid[0] != "storage" or not isinstance(pid[1], _Inert):
            raise pickle.UnpicklingError("it asks for something other than a storage")
        _, kind, key, _, numel = pid
        if not issubclass(kind, _Storage) or type(key) is not str or not key.isdecimal() or not _is_size(numel):
            raise pickle.UnpicklingError(f"the storage {key!r} is malformed")
        if key not in self._storages:
            dtype = np.dtype(kind.dtype).newbyteorder("<")
            storage = object.__new__(kind)
            storage.__dict__["array"] = np.frombuffer(
                self._read(f"{self._root}data/{key}", numel * dtype.itemsize), dtype
            )
            self._storages[key] = storage
        if type(self._storages[key]) is not kind or len(self._storages[key].array) != numel:
            raise pickle.UnpicklingError(f"the storage {key!r} does not have the size that the file states")
        return self._storages[key]

    def _read(self, name: str, limit: int) -> bytes:
        record = self._records.get(name)
        if record is None or record.compress_type != zipfile.ZIP_STORED or record.file_size > limit:
            raise pickle.UnpicklingError(f"its record {name!r} is missing, compressed, or too large")
        return self._archive.read(record)


def _shell(module: str, name: str) -> type:
    if (module, name) == ("collections", "OrderedDict"):
        return OrderedDict
    if module in ("__builtin__", "builtins") and name == "set":
        return set
    if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
        return _Inert(name, (Tensor,), {})
    if (module, name) == ("torch._utils", "_rebuild_parameter"):
        return _Inert(name, (_Parameter,), {})
    if module == "torch" and name in DTYPES:
        return _Inert(name, (_Storage,), {"dtype": DTYPES[name]})
    if (module, name) in IGNORED:
        return _Inert(name, (_Ignored,), {})
    if module.startswith(MODULES) and name.isidentifier():
        return _Inert(name, (Module,), {"kind": f"{module}.{name}"})
    if module.startswith("ultralytics."):
        raise pickle.UnpicklingError("it is YOLOv8 or later, of which only ONNX is read: export it as that")
    raise pickle.UnpicklingError(f"it names {module}.{name}, which a file of weights has no need of")


def _check_opcodes(text: bytes) -> None:
    """Only what PyTorch writes; and memo slots no higher than the pickle is long, for the unpickler allocates them."""
    tuples = 0
    for opcode, argument, _ in pickletools.genops(text):
        if opcode.name not in OPCODES or (opcode.name == "LONG_BINPUT" and (argument or 0) > len(text)):
            raise pickle.UnpicklingError(f"its pickle holds {opcode.name}, which PyTorch does not write")
        tuples += opcode.name.startswith("TUPLE")
    if tuples > MAX_TUPLES:
        raise pickle.UnpicklingError(f"its pickle holds {tuples} tuples, more than any network needs")


def _is_size(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**40


def _view(storage: Any, offset: Any, size: Any, stride: Any) -> np.ndarray:
    """A tensor's numbers, checked to lie inside its storage. A view that cannot be written to: copies of one
    storage could be asked for without end."""
    if not isinstance(storage, _Storage) or type(size) is not tuple or type(stride) is not tuple:
        raise pickle.UnpicklingError("a tensor is malformed")
    if len(size) != len(stride) or len(size) > 8 or not all(map(_is_size, (offset, *size, *stride))):
        raise pickle.UnpicklingError("a tensor's size is malformed")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    numbers = storage.array
    if math.prod(size) > len(numbers) or (math.prod(size) and last >= len(numbers)):
        raise pickle.UnpicklingError("a tensor reaches beyond its storage")
    steps = [step * numbers.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(numbers[offset:], size, steps, writeable=False)
