"""Serve a LeRobot policy over openvima's protocol: python -m lerobot_env_openvima.serve PATH_OR_ID.

`openvima evaluate --policy lerobot:PATH_OR_ID --python PYTHON` starts this and reads the address.
"""

import argparse
import copy
import hashlib
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import snapshot_download
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins

from openvima.data.lerobot_frames import ACTION_NAMES, IMAGE_PREFIX, frame_layout
from openvima.errors import PolicyError
from openvima.policies.base import Policy, prompt_hash
from openvima.scene import RenderedPrompt
from openvima.scene.action import COMMAND_NAMES, END_EFFECTOR, PRIMITIVES
from openvima.serving import serve
from openvima.serving.lerobot import lerobot_name


class LerobotPolicy(Policy):
    """A LeRobot policy for several episodes, each with action queues and random numbers of its own.

    Its control is that of its actions: primitives of 12 numbers, or commands of the tool of 5.

    Args:
        folder: A folder that `save_pretrained` wrote.
        device: Where the network computes.

    Raises:
        PolicyError: Its actions have another length.
    """

    modalities = ("rgb", "joints")

    def __init__(self, folder: Path, device: str) -> None:
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        self.kind, self.control = config.type, _control(config)
        self._network = get_policy_class(config.type).from_pretrained(folder, config=config)
        self._preprocess, self._postprocess = make_pre_post_processors(
            policy_cfg=config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": device}},
        )
        features = config.input_features or {}
        renamed = {key for step in self._preprocess.steps for key in getattr(step, "rename_map", {})}
        shown = {key for key in {*features, *renamed} if key.startswith(f"{IMAGE_PREFIX}prompt_")}
        num_images = max((int(key.split("_")[-2]) + 1 for key in shown), default=0)
        state = features.get(OBS_STATE)
        has_joints = state is None or state.shape != (1,)
        self._layout = frame_layout(self.control, num_images, has_joints)
        self._episodes: list[_Episode] = []

    def new_session(self) -> "LerobotPolicy":
        """Return a policy with the same weights and its own episodes."""
        session = copy.copy(self)
        session._episodes = []
        return session

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Start a batch of episodes."""
        self._episodes = [_Episode(prompt, self._own_network()) for prompt in prompts]

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:
        """Decide the next action of every running episode, one after another."""
        return [
            None if observation is None else self._action(episode, observation)
            for episode, observation in zip(self._episodes, observations, strict=True)
        ]

    def _own_network(self) -> torch.nn.Module:
        """Copy the network's queues but not its weights."""
        tensors = [*self._network.parameters(), *self._network.buffers()]
        network = copy.deepcopy(self._network, {id(tensor): tensor for tensor in tensors})
        network.reset()
        return network

    def _action(self, episode: "_Episode", observation: Mapping[str, Any]) -> Any:
        frame = self._layout.frame(observation, episode.prompt)
        batched = {"pixels": frame["pixels"], "agent_pos": frame["agent_pos"][None]}
        seen = {**preprocess_observation(batched), "task": [episode.prompt.text]}
        torch.manual_seed(episode.next_seed())
        with torch.inference_mode():
            action = self._postprocess(episode.network.select_action(self._preprocess(seen)))
        return self._layout.action(action[0].float().cpu().numpy())


def _control(config: PreTrainedConfig) -> str:
    feature = (config.output_features or {}).get(ACTION)
    shape = None if feature is None else tuple(feature.shape)
    controls = {(len(ACTION_NAMES),): PRIMITIVES, (len(COMMAND_NAMES),): END_EFFECTOR}
    if shape not in controls:
        raise PolicyError(
            f"actions of the policy have shape {shape}; allowed: ({len(ACTION_NAMES)},) for primitives, "
            f"({len(COMMAND_NAMES)},) for commands of the tool, as docs/lerobot.md lists them."
        )
    return controls[shape]


class _Episode:
    def __init__(self, prompt: RenderedPrompt, network: Any) -> None:
        self.prompt, self.network = prompt, network
        self._seed = prompt_hash(prompt) % 2**62

    def next_seed(self) -> int:
        self._seed += 1
        return self._seed


def policy_folder(path_or_id: str) -> Path:
    """Return a local folder, or the downloaded files of OWNER/NAME or OWNER/NAME@REVISION.

    Raises:
        PolicyError: It is neither a folder nor of that form.
    """
    if Path(path_or_id).is_dir():
        return Path(path_or_id)
    name, _, revision = path_or_id.partition("@")
    if name.count("/") != 1:
        raise PolicyError(
            f"there is no folder {path_or_id!r}; give one, or OWNER/NAME on the Hugging Face Hub."
        )
    return Path(
        snapshot_download(name, revision=revision or None, allow_patterns=["*.json", "*.safetensors"])
    )


def folder_hash(folder: Path) -> str:
    """SHA-256 over the weights, the statistics of normalization and the settings, as hexadecimal text."""
    digest = hashlib.sha256()
    for file in sorted([*folder.glob("*.safetensors"), *folder.glob("*.json")]):
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(prog=f"python -m {__spec__.name}", description=__doc__)
    parser.add_argument("policy", help="folder of a policy, or OWNER/NAME[@REVISION] on the Hugging Face Hub")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--port", type=int, default=0, help="by default a free one")
    parser.add_argument("--stop-with-input", action="store_true", help="stop when the standard input ends")
    given = parser.parse_args()
    register_third_party_plugins()
    folder = policy_folder(given.policy)
    policy = LerobotPolicy(folder, given.device)
    about = {
        "policy": {
            "name": lerobot_name(given.policy),
            "kind": f"lerobot {policy.kind}",
            "sha256": folder_hash(folder),
        },
        "versions": {name: version(name) for name in ("openvima", "lerobot", "torch")},
    }
    address_out, sys.stdout = sys.stdout, sys.stderr  # nothing else on the pipe that the address goes to
    if given.stop_with_input:
        threading.Thread(target=_stop_with_input, daemon=True).start()
    serve(policy, port=given.port, about=about, ready=lambda url: print(url, file=address_out, flush=True))


def _stop_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
