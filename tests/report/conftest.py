"""Made-up results, prompts and clips."""

from made_up_results import clip, prompt, results

__all__ = ["clip", "prompt", "results"]
