"""Griffe extension: reads the section `Example:` of docstrings as code."""

import re

from griffe import Extension, Object


class ExampleSections(Extension):
    """Gives the section the name that griffe knows."""

    def on_object(self, *, obj: Object, **_: object) -> None:
        """Rename the section of one docstring."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
