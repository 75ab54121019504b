"""`openvima serve`: let a policy be scored over the network, or from programs in other languages."""

import logging
import os
import sys
from dataclasses import asdict

from openvima.cli.terminal import Policy


def main(
    policy: Policy,
    *,
    port: int = 8000,
    host: str = "127.0.0.1",
    name: str | None = None,
    device: str = "cpu",
    threads: int = 1,
    prompts: str = "multimodal",
    max_connections: int = 16,
    max_episodes: int = 64,
    max_message_mb: int = 128,
    idle_s: float = 600.0,
    trust_code: bool = False,
) -> None:
    """Serve a policy until Ctrl-C; `openvima evaluate --policy ws://HOST:PORT` scores it.

    Messages are MessagePack with arrays over a WebSocket; docs/serving.md describes them for programs in
    other languages. Several clients may use the policy at once, each with episodes of its own.

    Example: openvima serve runs/first --port 8000

    Args:
        policy: openvima-small or openvima-vima (bundled), the folder of a training run, FILE.py:FUNCTION or
            MODULE:FUNCTION that makes a policy of your own, a published file, OWNER/NAME[@REVISION] on the
            Hub, random, untrained or untrained:PRESET (random weights).
        port: TCP port; 0 takes a free one. The address is printed once the server answers.
        host: Interface to listen on. Any but the loopback interface needs a token, a word that clients must
            know: that of the environment variable OPENVIMA_SERVE_TOKEN. Clients read it from there, too.
        name: Name in the metadata; by default that of the folder or file.
        device: Where a network computes: cpu, in float64, or cuda, in float32.
        threads: Threads that a network computes with on the cpu. More than one are faster for large networks,
            and may change the last bits of what it gives.
        prompts: How the policy gets prompts: multimodal, as clients send them; text, which puts a description
            such as "the red swirl letter A" in place of each object image; or mixed, which does so with
            probability ½. With ",paraphrased": synonyms.
        max_connections: Clients at the same time; `openvima evaluate` has one for each worker.
        max_episodes: Largest batch of episodes.
        max_message_mb: Size of the largest message, in 2**20 bytes; an image of a prompt takes 0.26.
        idle_s: Seconds after which a client is dropped that sends nothing.
        trust_code: Run the code that a run folder names, as that of a learner of your own does.
    """
    from openvima.evaluation.sources import policy_sources
    from openvima.imports import versions_of
    from openvima.policies import load_policy
    from openvima.serving import serve
    from openvima.serving.protocol import TOKEN_VARIABLE, require_extra
    from openvima.serving.server import ServerConfig

    require_extra()  # before the seconds that loading takes
    settings = ServerConfig(
        host=host,
        port=port,
        token=os.environ.get(TOKEN_VARIABLE) or None,
        max_message_bytes=max_message_mb * 2**20,
        max_episodes=max_episodes,
        max_connections=max_connections,
        idle_s=idle_s,
        num_threads=threads,
        prompts=prompts,
    )
    (source,) = policy_sources([f"{name}={policy}" if name else policy])
    source.check(trust_code=trust_code)
    loaded = load_policy(policy, device=device, trust_code=trust_code)
    packages = ("numpy",) if source.kind == "random" else ("numpy", "torch")
    about = {
        "policy": {"name": source.name, **source.record(), "device": device},
        "versions": dict(versions_of(*packages)),
    }
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    serve(loaded, **asdict(settings), about=about, ready=lambda url: print(url, flush=True))
