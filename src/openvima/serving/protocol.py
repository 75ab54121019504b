"""What a policy server and its clients say to each other; docs/serving.md tells it for other languages.

Messages are MessagePack. An array is a map of four entries with byte strings as keys, as open policy servers
send it: `__ndarray__` (true), `data` (its bytes, rows first), `dtype` (as numpy writes it, such as "<f4") and
`shape`. Nothing is ever unpickled, no type is looked up by a name that came with the message, and a length
counts only after it was compared with the bytes that are there.
"""

import ipaddress
import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np

from openvima.errors import ConfigError, MessageError, echo
from openvima.imports import import_extra
from openvima.policies.naming import SERVER_SCHEMES
from openvima.render.camera import VIEWS
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.scene.action import COMMAND_NAMES, CONTROLS, END_EFFECTOR, PRIMITIVES

DTYPES = {
    dtype.str: dtype
    for dtype in map(np.dtype, ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8"))
}
MAX_AXES = 8
# A million empty maps are a megabyte of MessagePack and 72 MB of Python. These bound what a message can take
# beyond its own size: the values in all its lists and maps; and those of one, as older versions of msgpack
# set memory aside for what a list claims to hold. A batch of 256 episodes has some 170,000 values.
MAX_VALUES = 1_000_000
MAX_LENGTH = 4096

_ARRAY = b"__ndarray__"
_NUMBER = b"__npgeneric__"  # a single number of numpy, as some clients send it
_ARRAY_KEYS = frozenset((_ARRAY, b"data", b"dtype", b"shape"))


def require_extra() -> None:
    """Check that messages can be packed and sent.

    Raises:
        MissingExtraError: A package is missing; the message names the extra.
    """
    for module in ("msgpack", "websockets"):
        import_extra(module, f"policy servers need {module}; install it with: pip install 'openvima[serve]'")


def pack(message: object) -> bytes:
    """Turn plain values and arrays into bytes.

    Args:
        message: None, booleans, numbers, texts, byte strings, lists and maps of such, and numpy arrays.

    Raises:
        MessageError: It holds something else, such as an array of Python objects.
    """
    import msgpack

    try:
        packed = msgpack.packb(message, default=_pack_array)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError(f"the message cannot be packed: {error}") from error
    assert isinstance(packed, bytes)
    return packed


def unpack(data: bytes) -> Any:
    """Turn bytes into plain values and arrays; the opposite of `pack`.

    Args:
        data: One whole message.

    Returns:
        What was packed. Arrays are new ones and may be written to.

    Raises:
        MessageError: The bytes are no MessagePack, or hold what is not allowed.
    """
    import msgpack

    counter = _ItemCounter()
    try:
        return msgpack.unpackb(
            data,
            object_hook=counter.map_or_array,
            list_hook=counter.list,
            max_array_len=MAX_LENGTH,
            max_map_len=MAX_LENGTH,
            max_ext_len=0,
        )
    except MessageError:
        raise
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise MessageError(f"these {len(data):,} bytes are no whole MessagePack message: {reason}") from error


class _ItemCounter:
    """Counts the values of a message while it is read."""

    def __init__(self) -> None:
        self._num_values = 0

    def list(self, values: list) -> list:
        self._count(len(values))
        return values

    def map_or_array(self, entries: dict) -> Any:
        self._count(len(entries))
        if _ARRAY in entries:
            return _unpack_array(entries)
        return _unpack_number(entries) if _NUMBER in entries else entries

    def _count(self, number: int) -> None:
        self._num_values += number + 1
        if self._num_values > MAX_VALUES:
            raise MessageError(f"the message holds more than {MAX_VALUES:,} values; arrays count as few.")


def _pack_array(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise MessageError(
            f"a value of type {type(value).__name__} cannot be sent; allowed are plain values, with whole "
            "numbers of up to 64 bits, and arrays."
        )
    dtype = value.dtype.newbyteorder("<")
    _checked_dtype(dtype.str)
    data = np.ascontiguousarray(value, dtype).tobytes()
    return {_ARRAY: True, b"data": data, b"dtype": dtype.str, b"shape": list(value.shape)}


def _unpack_array(entries: dict) -> np.ndarray:
    if set(entries) != _ARRAY_KEYS:
        raise MessageError("an array must have the entries __ndarray__, data, dtype and shape, as bytes.")
    data, shape = entries[b"data"], entries[b"shape"]
    dtype = _checked_dtype(entries[b"dtype"])
    if not isinstance(data, bytes):
        raise MessageError(f"data of an array is a {type(data).__name__}; it must be a byte string.")
    if not _is_shape(shape):
        raise MessageError(
            f"shape of an array must be a list of at most {MAX_AXES} whole numbers from 0 to 2**31 - 1."
        )
    needed = math.prod(shape) * dtype.itemsize
    if needed != len(data):
        raise MessageError(
            f"an array {dtype.str} of shape {tuple(shape)} takes {needed:,} bytes, got {len(data):,}."
        )
    return np.ndarray(shape, dtype, data).copy()


def _unpack_number(entries: dict) -> int | float:
    value = entries.get(b"data")
    _checked_dtype(entries.get(b"dtype"))
    if not isinstance(value, int | float):
        raise MessageError(f"data of a number is a {type(value).__name__}; it must be a number.")
    return value


def _checked_dtype(text: object) -> np.dtype:
    if not isinstance(text, str) or text not in DTYPES:
        shown = repr(text[:20]) if isinstance(text, str) else f"a {type(text).__name__}"
        raise MessageError(f"dtype of an array is {shown}; allowed: {', '.join(DTYPES)}.")
    return DTYPES[text]


def _is_shape(shape: object) -> bool:
    return (
        isinstance(shape, list)
        and len(shape) <= MAX_AXES
        and all(type(length) is int and 0 <= length < 2**31 for length in shape)  # a bool is no length
    )


# The number counts versions that do not understand each other: whatever is added, removed or changes its
# meaning makes a new one, as both sides refuse what they do not know.
PROTOCOL = "openvima-policy/1"
POLICY_FAILED = "the policy failed: "  # begins a refusal whose cause is the policy, for this one request
TOKEN_VARIABLE = "OPENVIMA_SERVE_TOKEN"  # read by server and client where no token is given
MODALITIES = ("rgb", "segm", "joints")  # that observations may hold besides `ee`
DEFAULT_MODALITIES = ("rgb", "segm")  # of policies that name none
MAX_PIXELS = 2**20  # of an image; those of the benchmark have 2**15

_KINDS: tuple[Literal["object", "scene"], ...] = ("object", "scene")
_LENGTHS = {"joints": 6, "tool": len(COMMAND_NAMES)}  # of what observations hold as numbers
_RECORD_TYPES: dict[str, type] = {"object_id": int, "object": str, "texture": str}


def is_loopback(host: str) -> bool:
    """Whether a host name or address is certain to mean this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_address(url: str) -> None:
    """Check that a text can be the address of a server.

    Raises:
        ConfigError: It has another scheme, no host, a port that is none, or a fragment.
    """
    try:
        parts = urlsplit(url)
        usable = (
            url.startswith(SERVER_SCHEMES) and bool(parts.hostname) and parts.port != 0 and not parts.fragment
        )
    except ValueError:  # the port is no number
        usable = False
    if not usable or not url.isprintable():
        shown = echo(repr(url))
        raise ConfigError(f"the address of a policy server is {shown}; it must be ws://HOST:PORT or wss://….")


def check_token(token: str | None) -> None:
    """Check that a token can be sent in a header.

    Raises:
        ConfigError: It is empty, or holds spaces or other than plain characters.
    """
    if token is not None and not (token and token.isascii() and token.isprintable() and " " not in token):
        raise ConfigError("the token must be of printable ASCII characters without spaces, and not empty.")


def encode_prompt(prompt: RenderedPrompt) -> dict[str, Any]:
    """Turn a prompt into plain values and arrays."""
    return {"text": prompt.text, "images": [_encode_image(image) for image in prompt.images.values()]}


def decode_prompt(message: object, where: str = "prompt") -> RenderedPrompt:
    """Read a prompt out of a message.

    Args:
        message: What was sent.
        where: How to name it in errors.

    Raises:
        MessageError: It is no prompt; the message says what is wrong.
    """
    fields = _map(message, where, required=("text",), optional=("images",))
    text = _typed(fields["text"], str, f"{where}: text")
    images = [
        _decode_image(image, f"{where}: image {number}")
        for number, image in enumerate(_typed(fields.get("images", []), list, f"{where}: images"))
    ]
    by_name = {image.name: image for image in images}
    if len(by_name) < len(images):
        raise MessageError(f"{where}: two images have one name; each placeholder has one image.")
    for number, image in enumerate(images):
        if len({record.object_id for record in image.objects}) < len(image.objects):
            raise MessageError(f"{where}: image {number}: two objects have one object_id.")
    return RenderedPrompt(text, by_name)


def encode_observation(observation: Mapping | None) -> dict[str, Any] | None:
    """Turn an observation (`rgb`, `segm`, `joints`, `tool`, `ee`) into plain values; None stays None."""
    if observation is None:
        return None
    parts = {part: dict(observation[part]) for part in ("rgb", "segm") if part in observation}
    parts |= {part: observation[part] for part in _LENGTHS if part in observation}
    return {**parts, "ee": int(observation["ee"])}


def decode_observation(
    message: object, where: str = "observation", *, control: str = PRIMITIVES
) -> dict[str, Any] | None:
    """Read an observation out of a message; None stands for an episode that has ended.

    Args:
        message: What was sent.
        where: How to name it in errors.
        control: That of the policy; with "end_effector" the observation holds `tool`.

    Raises:
        MessageError: It is no observation; the message says what is wrong.
    """
    if message is None:
        return None
    required = ("rgb", "ee", "tool") if control == END_EFFECTOR else ("rgb", "ee")
    fields = _map(message, where, required=required, optional=("segm", "joints"))
    _check_views(fields, where)
    for part in (part for part in _LENGTHS if part in fields):
        numbers = _typed(fields[part], np.ndarray, f"{where}: {part}")
        shape = (_LENGTHS[part],)
        if numbers.shape != shape or numbers.dtype != np.float32 or not np.isfinite(numbers).all():
            raise MessageError(
                f"{where}: {part} is {numbers.dtype} {numbers.shape}; it must be float32 {shape}, all finite."
            )
    if type(fields["ee"]) is not int:  # a bool is no number of a tool
        raise MessageError(f"{where}: ee is {_shown(fields['ee'])}; it must be a whole number.")
    return fields


def encode_action(action: Any, control: str = PRIMITIVES) -> Any:
    """Turn an action of a policy into arrays; None stays None.

    Raises:
        MessageError: It is not of the form of the control.
    """
    if action is None:
        return None
    if control == END_EFFECTOR:
        return decode_action(action if isinstance(action, Mapping) else np.asarray(action), control=control)
    if not isinstance(action, Mapping):
        raise MessageError(f"action is {_shown(action)}; it must be a map.")
    return {str(key): np.asarray(value) for key, value in action.items()}


def decode_action(message: object, where: str = "action", *, control: str = PRIMITIVES) -> Any:
    """Read an action out of a message. Whether it is one that can be done, the environment says.

    Args:
        message: What was sent.
        where: How to name it in errors.
        control: That of the policy.

    Returns:
        A map of arrays, or with control "end_effector" one array; None for None.

    Raises:
        MessageError: It is something else.
    """
    if message is None:
        return None
    if control == END_EFFECTOR:
        return _typed(message, np.ndarray, where)
    for key, value in _typed(message, dict, where).items():
        _typed(value, np.ndarray, f"{where}: {_shown(key)}")
    return message


def check_control(control: object, whose: str) -> str:
    """Return the control that a policy declares.

    Args:
        control: What it declares.
        whose: How to name the policy in the error.

    Raises:
        MessageError: There is no such control.
    """
    if not isinstance(control, str) or control not in CONTROLS:
        raise MessageError(f"{whose} has control {_shown(control)}; allowed: {', '.join(CONTROLS)}.")
    return control


def check_modalities(names: object, whose: str) -> tuple[str, ...]:
    """Return the modalities that a policy asks for.

    Args:
        names: What it names.
        whose: How to name the policy in the error.

    Raises:
        MessageError: It is no list of modalities that are sent, or "rgb" is not among them.
    """
    listed = list(names) if isinstance(names, list | tuple) else []
    if "rgb" not in listed or any(name not in MODALITIES for name in listed):
        raise MessageError(
            f"{whose} has modalities {echo(repr(names))}; servers get rgb and, if asked, segm and joints."
        )
    return tuple(name for name in MODALITIES if name in listed)


def read_list(
    message: object, kind: str, field: str, max_length: int, *, optional: tuple[str, ...] = ()
) -> list:
    """Take the list out of a request or reply.

    Args:
        message: What was sent: {"type": kind, field: [...]}.
        kind: The type that it has, which was looked at before.
        field: Name of the list.
        max_length: Entries that it may have at most.
        optional: What else the message may hold.

    Raises:
        MessageError: The list is missing or too long, or there is something else.
    """
    fields = _map(message, kind, required=("type", field), optional=optional)
    values = _typed(fields[field], list, f"{kind}: {field}")
    if len(values) > max_length:
        raise MessageError(f"{kind} has {len(values)} {field}; at most {max_length} are allowed.")
    return values


def check_protocol(protocol: object, *, theirs: str, ours: str) -> None:
    """Check that both sides speak the same version of the protocol.

    Args:
        protocol: What the other side says that it speaks.
        theirs: How to name the other side in the error.
        ours: How to name this side.

    Raises:
        MessageError: It is another one, or none that is known.
    """
    if not isinstance(protocol, str) or protocol != PROTOCOL:  # an array is not compared
        raise MessageError(
            f"{theirs} speaks {_shown(protocol)}, {ours} {PROTOCOL!r}; use versions of openvima that speak "
            "the same on both sides."
        )


def type_of(message: object) -> str | None:
    """The type of a request or reply; None where it names none, or one that is no text."""
    kind = message.get("type") if isinstance(message, dict) else None
    return kind if isinstance(kind, str) else None


def _encode_image(image: PromptImage) -> dict[str, Any]:
    records = [{key: getattr(record, key) for key in _RECORD_TYPES} for record in image.objects]
    rgb, segm = dict(image.rgb), dict(image.segm)
    return {"name": image.name, "kind": image.kind, "rgb": rgb, "segm": segm, "objects": records}


def _decode_image(message: object, where: str) -> PromptImage:
    fields = _map(message, where, required=("name", "kind", "rgb", "segm"), optional=("objects",))
    name = _typed(fields["name"], str, f"{where}: name")
    given = fields["kind"] if isinstance(fields["kind"], str) else None
    kind: Literal["object", "scene"] | None = next((k for k in _KINDS if k == given), None)
    if kind is None:
        raise MessageError(f"{where}: kind is {_shown(fields['kind'])}; allowed: {', '.join(_KINDS)}.")
    _check_views(fields, where)
    records = _typed(fields.get("objects", []), list, f"{where}: objects")
    objects = tuple(_decode_record(record, f"{where}: object {n}") for n, record in enumerate(records))
    return PromptImage(name, kind, fields["rgb"], fields["segm"], objects)


def _decode_record(message: object, where: str) -> ObjectRecord:
    fields = _map(message, where, required=tuple(_RECORD_TYPES))
    for key, kind in _RECORD_TYPES.items():
        _typed(fields[key], kind, f"{where}: {key}")
    if not 0 <= fields["object_id"] <= 255:
        raise MessageError(f"{where}: object_id is {fields['object_id']}; it must lie in 0 … 255.")
    return ObjectRecord(**fields)


def _check_views(fields: Mapping[str, Any], where: str) -> None:
    """Check `rgb` and `segm`: uint8 images of one size a view, with at most `MAX_PIXELS`."""
    sizes: dict[object, tuple[int, ...]] = {}
    for part in (part for part in ("rgb", "segm") if part in fields):
        for view, image in _typed(fields[part], dict, f"{where}: {part}").items():
            if view not in VIEWS:
                raise MessageError(f"{where}: {part} has a view {_shown(view)}; allowed: {', '.join(VIEWS)}.")
            array = _typed(image, np.ndarray, f"{where}: {part} {_shown(view)}")
            lead = (3,) if part == "rgb" else ()
            size = array.shape[len(lead) :]
            whole = array.dtype == np.uint8 and len(size) == 2 and array.shape[: len(lead)] == lead
            if not whole or sizes.setdefault(view, size) != size:
                wanted = "(3, height, width)" if lead else "(height, width), as rgb has them"
                raise MessageError(
                    f"{where}: {part} {_shown(view)} is {array.dtype} {array.shape}; it must be uint8 "
                    f"{wanted}."
                )
            if math.prod(size) > MAX_PIXELS:
                raise MessageError(
                    f"{where}: {part} {_shown(view)} has {size[0]} × {size[1]} pixels; at most "
                    f"{MAX_PIXELS:,} are allowed."
                )


def _map(
    message: object, where: str, *, required: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Check that something is a map with these entries and no others."""
    fields = _typed(message, dict, where)
    missing = [key for key in required if key not in fields]
    unknown = [key for key in fields if key not in required + optional]
    if missing or unknown:
        problems = [*(["it lacks " + _listed(missing)] if missing else [])]
        problems += [f"it has {_listed(unknown)}, which nobody knows"] if unknown else []
        raise MessageError(f"{where}: {' and '.join(problems)}; entries: {', '.join(required + optional)}.")
    return fields


def _typed(value: object, kind: type, where: str) -> Any:
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        names = {dict: "a map", list: "a list", str: "a text", int: "a whole number", np.ndarray: "an array"}
        raise MessageError(f"{where} is {_shown(value)}; it must be {names[kind]}.")
    return value


def _listed(keys: Iterable[object]) -> str:
    shown = [_shown(key) for key in keys]
    return ", ".join(shown[:5]) + (" …" if len(shown) > 5 else "")


def _shown(value: object) -> str:
    """Name a value in an error: short, whatever was sent."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str | bytes):
        return repr(value[:40])
    return f"a {type(value).__name__}"
