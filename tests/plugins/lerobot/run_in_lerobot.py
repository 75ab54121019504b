"""Runs in LeRobot's environment: saves the scripted policy, and runs lerobot-eval on a policy.

Usage: python run_in_lerobot.py save FOLDER
       python run_in_lerobot.py eval ACTIONS.json OPTIONS_OF_LEROBOT_EVAL…
"""

import json
import sys
from pathlib import Path

from lerobot.scripts import lerobot_eval
from lerobot_env_openvima import OpenVimaEnv

from openvima.data.lerobot.features import action_from_row


def save(folder: Path) -> None:
    """Save the scripted policy, with processors that pass everything on."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.device_processor import DeviceProcessorStep
    from lerobot.processor.rename_processor import RenameObservationsProcessorStep
    from lerobot_policy_scripted.configuration_scripted import ScriptedConfig
    from lerobot_policy_scripted.modeling_scripted import ScriptedPolicy

    ScriptedPolicy(ScriptedConfig(device="cpu", push_to_hub=False)).save_pretrained(folder)
    steps = [RenameObservationsProcessorStep(rename_map={}), DeviceProcessorStep(device="cpu")]
    PolicyProcessorPipeline(steps=steps, name="policy_preprocessor").save_pretrained(folder)
    PolicyProcessorPipeline(steps=steps[1:], name="policy_postprocessor").save_pretrained(folder)


def evaluate(actions: Path, options: list[str]) -> None:
    """Run lerobot-eval and store the actions of each seed, as the environment takes them."""
    found: dict[int, list] = {}
    step = OpenVimaEnv.step

    def recorded(env: OpenVimaEnv, action):
        taken = [float(number) for part in action_from_row(action).values() for number in part]
        found.setdefault(env._env.episode.seed, []).append(taken)
        return step(env, action)

    OpenVimaEnv.step = recorded
    sys.argv = ["lerobot-eval", *options]
    lerobot_eval.main()
    actions.write_text(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1] == "save":
        save(Path(sys.argv[2]))
    else:
        evaluate(Path(sys.argv[2]), sys.argv[3:])
