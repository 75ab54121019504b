"""What the report says on whether outcomes were confirmed by replaying the recorded actions."""

import shlex
from dataclasses import dataclass

from openvima.evaluation.results import DECLARED, Results


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Whether the outcomes of an evaluation were confirmed.

    Args:
        folder: Name of its folder, for the command that confirms it.
        confirmed: Whether the folder holds the mark of `verify_results` for just these results.
        replayable: Whether the actions were recorded.
    """

    folder: str
    confirmed: bool
    replayable: bool = True

    @staticmethod
    def of(results: Results, folder: str, *, confirmed: bool) -> "Confirmation":
        """Describe the confirmation of some results."""
        return Confirmation(folder, confirmed, bool(results.actions_sha256))

    @property
    def text(self) -> str:
        """What is known, and how to check it, in two or three sentences."""
        if self.confirmed:
            return (
                "Confirmed by replay: with the recorded actions, every episode ends as stated. Declared, not "
                f"proven: {DECLARED}. The mark is a file of the folder; if that came from elsewhere, it is a "
                f"claim until {self.command} confirms it again."
            )
        if not self.replayable:
            return "Not confirmed by replay: the actions were not recorded."
        return (
            f"Not confirmed by replay. {self.command} plays the recorded actions again, without the policy."
        )

    @property
    def command(self) -> str:
        """The command that confirms the evaluation."""
        return f"openvima verify-results {shlex.quote(self.folder)}"
