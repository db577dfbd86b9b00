"""YAML of files and of `--set`, which may be damaged or malicious."""

from typing import Any

import yaml

from segslam.core.errors import SegslamError, brief


class _Loader(yaml.SafeLoader):
    """Rejects duplicate keys, of which YAML's own loader uses the last, and aliases, which multiply a short text."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As in the base class. Raises ComposerError, with its line, for an alias."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, f"*{event.anchor}: write the value itself", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As in the base class. Raises ConstructorError, with its line, for a duplicate key."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key must be a name", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str, source: str) -> Any:
    """The value of a YAML text. Raises SegslamError, naming the source, for an invalid text."""
    try:
        return yaml.load(text, _Loader)
    except RecursionError as error:
        raise SegslamError(f"{source}: not valid YAML (nested too deeply)") from error
    except (yaml.YAMLError, ValueError, ArithmeticError) as error:
        # The errors after the first are those of dates and numbers that do not exist, such as 2001-99-99 or 0x_.
        raise SegslamError(f"{source}: not valid YAML ({brief(str(error), 300)})") from error


def short(value: Any) -> str:
    """The value as in Python, cut to 80 characters."""
    try:
        return brief(repr(value))
    except ValueError:  # Python writes no number of more than 4300 digits
        return f"a {type(value).__name__} with too many digits"
