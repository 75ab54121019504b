"""What a policy server and its clients say to each other; docs/serving.md tells it for other languages.

Messages are MessagePack. An array is a map of four entries with byte strings as keys, as open policy servers
send it: `__ndarray__` (true), `data` (its bytes, rows first), `dtype` (as numpy writes it, such as "<f4") and
`shape`. Nothing is ever unpickled, no type is looked up by a name that came with the message, and a length
counts only after it was compared with the bytes that are there.
"""

import ipaddress
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from openvima.errors import ConfigError, MessageError, echo
from openvima.imports import import_extra
from openvima.policies.naming import SERVER_SCHEMES
from openvima.render.camera import VIEWS
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.scene.action import COMMAND_NAMES, END_EFFECTOR, PRIMITIVES

DTYPES = {
    name: np.dtype(name)
    for name in ["|u1", "<u2", "<u4", "<u8", "|i1", "<i2", "<i4", "<i8", "<f2", "<f4", "<f8"]
}
MAX_LENGTH = 4096  # of a list or map: older versions of msgpack set memory aside for what one claims to hold

_ARRAY = b"__ndarray__"
_NUMBER = b"__npgeneric__"  # a single number of numpy, as some clients send it


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

    try:
        return msgpack.unpackb(
            data,
            object_hook=_unpack_array,
            max_array_len=MAX_LENGTH,
            max_map_len=MAX_LENGTH,
            max_ext_len=0,
        )
    except MessageError:
        raise
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise MessageError(f"these {len(data):,} bytes are no whole MessagePack message: {reason}") from error


def _pack_array(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray) or (dtype := value.dtype.newbyteorder("<")).str not in DTYPES:
        kind = repr(value.dtype.str) if isinstance(value, np.ndarray) else type(value).__name__
        raise TypeError(
            f"a value of type {kind} cannot be sent; allowed are plain values, with whole numbers of up to "
            f"64 bits, and arrays of dtype {', '.join(DTYPES)}."
        )
    data = np.ascontiguousarray(value, dtype).tobytes()
    return {_ARRAY: True, b"data": data, b"dtype": dtype.str, b"shape": list(value.shape)}


def _unpack_array(entries: dict) -> Any:
    if _NUMBER in entries:
        return entries.get(b"data")
    if _ARRAY not in entries:
        return entries
    try:
        flat = np.frombuffer(entries[b"data"], DTYPES[entries[b"dtype"]])
        if any(type(length) is not int or length < 0 for length in entries[b"shape"]):
            raise ValueError("a shape is a list of whole numbers")
        return flat.reshape(entries[b"shape"]).copy()
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise MessageError(
            f"an array is damaged ({echo(repr(error), 80)}): it must have the entries __ndarray__, data, "
            f"dtype and shape, as bytes, and one of the dtypes {', '.join(DTYPES)}."
        ) from None


# The number counts versions that do not understand each other: whatever is added, removed or changes its
# meaning makes a new one, as both sides refuse what they do not know.
PROTOCOL = "openvima-policy/1"
POLICY_FAILED = "the policy failed: "  # begins a refusal whose cause is the policy, for this one request
TOKEN_VARIABLE = "OPENVIMA_SERVE_TOKEN"  # read by server and client where no token is given
MODALITIES = ("rgb", "segm", "joints")  # that observations may hold besides `ee`
DEFAULT_MODALITIES = ("rgb", "segm")  # of policies that name none


def is_loopback(host: str) -> bool:
    """Whether a host name or address is certain to mean this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_address(url: str) -> None:
    """Check that a text can be the address of a server.

    Raises:
        ConfigError: It has another scheme, no host, or a port that is none.
    """
    try:
        parts = urlsplit(url)
        is_one = url.startswith(SERVER_SCHEMES) and parts.hostname and parts.port != 0
    except ValueError:  # the port is no number
        is_one = False
    if not is_one or not url.isprintable():
        shown = echo(repr(url))
        raise ConfigError(f"the address of a policy server is {shown}; it must be ws://HOST:PORT or wss://….")


Check = Callable[[Any, str], None]
Form = type | tuple[str, ...] | list | dict | Check
_NAMES = {dict: "a map", list: "a list", str: "a text", int: "a whole number", np.ndarray: "an array"}


def check_form(value: Any, form: Form, where: str) -> Any:
    """Check what was sent, with all that it holds, and return it.

    Args:
        value: What was sent.
        form: A type; texts to choose from; a list with the form of entries; a map from names to forms, where
            a question mark ends names that may be missing; or a function that checks.
        where: How to name it in errors.

    Raises:
        MessageError: It is something else; the message says what is wrong.
    """
    if isinstance(form, tuple):
        if not isinstance(value, str) or value not in form:
            raise MessageError(f"{where} is {_shown(value)}; allowed: {', '.join(form)}.")
    elif isinstance(form, list):
        for number, entry in enumerate(check_form(value, list, where)):
            check_form(entry, form[0], f"{where} {number}")
    elif isinstance(form, dict):
        known = {name.removesuffix("?"): each for name, each in form.items()}
        missing = [name for name in form if name not in check_form(value, dict, where) and name in known]
        unknown = [_shown(name) for name in value if name not in known]
        if missing or unknown:
            problem = f"it has {unknown[0]}, which nobody knows" if unknown else f"it lacks {missing[0]!r}"
            raise MessageError(f"{where}: {problem}; entries: {', '.join(known)}.")
        for name, entry in value.items():
            check_form(entry, known[name], f"{where}: {name}")
    elif not isinstance(form, type):
        form(value, where)
    elif not isinstance(value, form) or (form is int and isinstance(value, bool)):
        raise MessageError(f"{where} is {_shown(value)}; it must be {_NAMES[form]}.")
    return value


def _array(dtype: str, *shape: int) -> Check:
    """Check arrays of a shape, where 0 stands for any length."""

    def check(value: Any, where: str) -> None:
        array = check_form(value, np.ndarray, where)
        fits = array.ndim == len(shape) and all(n in (0, m) for n, m in zip(shape, array.shape, strict=True))
        if array.dtype != dtype or not fits or not np.isfinite(array).all():
            wanted = "".join(f"{length or 'any'}, " for length in shape)
            raise MessageError(
                f"{where} is {array.dtype} {array.shape}; it must be {dtype} ({wanted[:-1]}), all finite."
            )

    return check


def _id(value: Any, where: str) -> None:
    if not 0 <= check_form(value, int, where) <= 255:
        raise MessageError(f"{where} is {value}; it must lie in 0 … 255.")


_IMAGES = {
    "rgb": {f"{view}?": _array("uint8", 3, 0, 0) for view in VIEWS},
    "segm": {f"{view}?": _array("uint8", 0, 0) for view in VIEWS},
}
_PROMPT: dict = {
    "text": str,
    "images?": [
        {
            "name": str,
            "kind": ("object", "scene"),
            **_IMAGES,
            "objects?": [{"object_id": _id, "object": str, "texture": str}],
        }
    ],
}
_OBSERVATION: dict = {
    "rgb": _IMAGES["rgb"],
    "ee": int,
    "segm?": _IMAGES["segm"],
    "joints?": _array("float32", 6),
}
_TOOL = _array("float32", len(COMMAND_NAMES))


def encode_prompt(prompt: RenderedPrompt) -> dict[str, Any]:
    """Turn a prompt into plain values and arrays."""
    images = [
        {
            "name": image.name,
            "kind": image.kind,
            "rgb": dict(image.rgb),
            "segm": dict(image.segm),
            "objects": [asdict(each) for each in image.objects],
        }
        for image in prompt.images.values()
    ]
    return {"text": prompt.text, "images": images}


def decode_prompt(message: object, where: str = "prompt") -> RenderedPrompt:
    """Read a prompt out of a message.

    Args:
        message: What was sent.
        where: How to name it in errors.

    Raises:
        MessageError: It is no prompt; the message says what is wrong.
    """
    fields, by_name = check_form(message, _PROMPT, where), {}
    for image in fields.get("images", []):
        objects = tuple(ObjectRecord(**record) for record in image.get("objects", ()))
        by_name[image["name"]] = PromptImage(**{**image, "objects": objects})
    if len(by_name) < len(fields.get("images", [])):
        raise MessageError(f"{where}: two images have one name; each placeholder has one image.")
    return RenderedPrompt(fields["text"], by_name)


def encode_observation(observation: Mapping | None) -> dict[str, Any] | None:
    """Turn an observation (`rgb`, `segm`, `joints`, `tool`, `ee`) into plain values; None stays None."""
    if observation is None:
        return None
    parts = {part: dict(observation[part]) for part in ("rgb", "segm") if part in observation}
    parts |= {part: observation[part] for part in ("joints", "tool") if part in observation}
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
    return check_form(message, _OBSERVATION | ({"tool": _TOOL} if control == END_EFFECTOR else {}), where)


def encode_action(action: Any) -> Any:
    """Turn an action of a policy into arrays; None stays None."""
    if isinstance(action, Mapping):
        return {str(key): np.asarray(value) for key, value in action.items()}
    return None if action is None else np.asarray(action)


def decode_action(message: Any, where: str = "action", *, control: str = PRIMITIVES) -> Any:
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
    return (
        None if message is None else check_form(message, dict if control == PRIMITIVES else np.ndarray, where)
    )


def check_modalities(names: object) -> tuple[str, ...]:
    """Return the modalities that a policy asks for.

    Args:
        names: What it names.

    Raises:
        MessageError: It is no list of modalities that are sent, or "rgb" is not among them.
    """
    listed = list(names) if isinstance(names, list | tuple) else []
    if "rgb" not in listed or any(name not in MODALITIES for name in listed):
        raise MessageError(
            f"the policy has modalities {echo(repr(names))}; servers get rgb and, if asked, segm and joints."
        )
    return tuple(name for name in MODALITIES if name in listed)


def _shown(value: object) -> str:
    """Name a value in an error: short, whatever was sent."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    return repr(value[:40]) if isinstance(value, str | bytes) else f"a {type(value).__name__}"
