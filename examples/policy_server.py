"""A policy server without openvima; any language with WebSocket and MessagePack will do.

Run `python examples/policy_server.py 8000`, then `openvima evaluate --policy mine=ws://127.0.0.1:8000`.
"""

import sys

import msgpack
import numpy as np
from websockets.sync.server import serve


def _pack(a):
    return {b"__ndarray__": True, b"data": a.tobytes(), b"dtype": a.dtype.str, b"shape": a.shape}


def _unpack(m):
    return np.ndarray(m[b"shape"], m[b"dtype"], m[b"data"]) if b"__ndarray__" in m else m


def act(seen):
    """Put the second largest visible object into the largest."""
    ids, counts = np.unique(seen["segm"]["top"], return_counts=True)
    largest = ids[np.argsort(-np.where((ids > 1) & (ids < 255), counts, 0))][:2]  # 0 and 1 are the table
    place, pick = (np.argwhere(seen["segm"]["top"] == i).mean(axis=0) / 251 + (0.25, -0.51) for i in largest)
    poses = {"pose0_position": pick, "pose1_position": place}
    poses |= {"pose0_rotation": np.array([0, 0, 0, 1]), "pose1_rotation": np.array([0, 0, 0, 1])}
    return {key: value.astype(np.float32) for key, value in poses.items()}


def serve_client(connection):
    """Send the handshake, then answer requests; the prompts of "reset" are ignored."""
    connection.send(msgpack.packb({"protocol": "openvima-policy/1", "policy": {"name": "into-the-largest"}}))
    for request in (msgpack.unpackb(data, object_hook=_unpack) for data in connection):
        actions = [seen and act(seen) for seen in request.get("observations", [])]
        connection.send(msgpack.packb({"type": request["type"], "actions": actions}, default=_pack))


serve(serve_client, "127.0.0.1", int(sys.argv[1]), max_size=2**27).serve_forever()
