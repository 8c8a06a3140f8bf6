"""Host functions that compiled programs call by name.

A program with jax.pure_callback holds the address of its Python function, so that JAX cannot keep
it in the compile cache: it is compiled anew in every process and for every instance of a robot,
some 4 s for the walker's rollout. A call through XLA's foreign function interface names its target
instead. `call` gives every program the one target `mjx_cl_host`, a C function pointer that ctypes
makes of a Python function, and the name of the host function as an attribute. Names must say all
that the function's results depend on: a program from the cache calls whatever this process has
registered under the name that it was compiled with. A call also costs a fifth of a pure_callback's.

Struct layouts: xla/ffi/api/c_api.h (API 0.3) of jaxlib TESTED. With any other version of jaxlib
nothing is registered, and `call` is a jax.pure_callback: the same numbers, but such programs are
compiled anew in every process.
"""

import ctypes
import functools
import math
import threading
import traceback
import weakref
from collections.abc import Callable
from typing import Any

import jax
import jaxlib
import numpy as np

TARGET = "mjx_cl_host"
TESTED = "0.9.2"  # the jaxlib whose struct layouts these are
# XLA_FFI_Extension_Metadata, XLA_FFI_ExecutionStage_EXECUTE, XLA_FFI_Error_Code_INTERNAL
_METADATA, _EXECUTE, _INTERNAL = 1, 3, 13
_BETWEEN = "|"  # in an attribute: between name and word
_P, _N, _INT, _INT64 = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int64


def _plain(*fields: tuple[str, Any]) -> Any:
  return type("Struct", (ctypes.Structure,), {"_fields_": list(fields)})


def _struct(*fields: tuple[str, Any]) -> Any:
  """A struct of the interface: its size, its extensions, then `fields`."""
  return _plain(("struct_size", _N), ("extension", _P), *fields)


_Version = _struct(("major", _INT), ("minor", _INT))
_Metadata = _plain(("struct_size", _N), ("version", _Version), ("traits", ctypes.c_uint32))
_Extension = _plain(
  ("struct_size", _N), ("type", _INT), ("next", _P), ("metadata", ctypes.POINTER(_Metadata))
)
_Span = _plain(("data", _P), ("size", _N))
_Buffer = _struct(("dtype", _INT), ("data", _P), ("rank", _INT64), ("dims", ctypes.POINTER(_INT64)))
_Buffers = _struct(("size", _INT64), ("types", _P), ("at", ctypes.POINTER(ctypes.POINTER(_Buffer))))
_Attributes = _struct(
  ("size", _INT64), ("types", _P), ("names", _P), ("at", ctypes.POINTER(ctypes.POINTER(_Span)))
)
_ErrorArgs = _struct(("message", ctypes.c_char_p), ("code", _INT))
_Api = _struct(
  ("version", _Version),
  ("internal", _P),
  ("error_create", ctypes.CFUNCTYPE(_P, ctypes.POINTER(_ErrorArgs))),
)
_Frame = _struct(
  ("api", ctypes.POINTER(_Api)),
  ("context", _P),
  ("stage", _INT),
  ("args", _Buffers),
  ("results", _Buffers),
  ("attributes", _Attributes),
)

_functions: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_lock = threading.Lock()


def _array(buffer: Any) -> np.ndarray:
  """The buffer's numbers, uint32, without a copy."""
  shape = buffer.dims[: buffer.rank]
  size = math.prod(shape)
  memory = (ctypes.c_uint32 * size).from_address(buffer.data) if size else ()
  return np.asarray(memory, np.uint32).reshape(shape)


def _look_up(name: str, word: str) -> Callable[[np.ndarray], np.ndarray]:
  function = _functions.get(name)
  if function is None:
    raise LookupError(
      f"the host function {name} of this program is gone; keep its robot for as long as the program"
    )
  return functools.partial(function, word)


def _run(frame: Any) -> None:
  """One call: the function named by the only attribute, on the only operand."""
  span = frame.attributes.at[0].contents
  name, _, word = ctypes.string_at(span.data, span.size).decode().partition(_BETWEEN)
  operand = _array(frame.args.at[0].contents)
  operand.flags.writeable = False
  _array(frame.results.at[0].contents)[...] = _look_up(name, word)(operand)


@ctypes.CFUNCTYPE(_P, ctypes.POINTER(_Frame))
def _handler(pointer: Any) -> int | None:
  """XLA_FFI_Handler: null, or an XLA_FFI_Error."""
  frame = pointer.contents
  if frame.extension:
    extension = _Extension.from_address(frame.extension)
    if extension.type == _METADATA:
      extension.metadata.contents.version.major = 0
      extension.metadata.contents.version.minor = 3
      return None
  if frame.stage != _EXECUTE:
    return None
  try:
    _run(frame)
    return None
  except BaseException:  # an exception cannot cross C
    args = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, traceback.format_exc().encode(), _INTERNAL)
    return frame.api.contents.error_create(ctypes.byref(args))


def registered() -> bool:
  """Whether XLA has taken the target; another jaxlib than TESTED is not asked."""
  return jaxlib.__version__ == TESTED and _register()


@functools.cache
def _register() -> bool:
  new = ctypes.pythonapi.PyCapsule_New
  new.restype, new.argtypes = ctypes.py_object, [_P, ctypes.c_char_p, _P]
  try:
    jax.ffi.register_ffi_target(TARGET, new(ctypes.cast(_handler, _P), None, None), platform="cpu")
  except Exception:  # a platform that jaxlib was built otherwise for
    return False
  return True


def shared(name: str, make: Callable[[], Any]) -> Any:
  """What is registered under `name`, or else `make()`, registered for as long as someone holds it:
  a function (word, uint32 array) -> uint32 array.
  """
  if _BETWEEN in name:
    raise ValueError(f"a name without {_BETWEEN!r}, not {name!r}")
  with _lock:
    function = _functions.get(name)
    if function is None:
      function = _functions[name] = make()
    return function


def call(name: str, word: str, width: int, operand: jax.Array) -> jax.Array:
  """The function `name` on (word, operand), uint32 (n,) -> (width,); under vmap one call on (...,
  n) -> (..., width).

  Its operand is read-only memory of the program, valid during the call. An exception ends the
  program, with its traceback in the message.
  """
  shape = jax.ShapeDtypeStruct((width,), np.uint32)
  if jax.default_backend() == "cpu" and registered():
    return jax.ffi.ffi_call(TARGET, shape, vmap_method="broadcast_all")(
      operand, name=name + _BETWEEN + word
    )
  return jax.pure_callback(
    lambda x: _look_up(name, word)(np.asarray(x)), shape, operand, vmap_method="broadcast_all"
  )
