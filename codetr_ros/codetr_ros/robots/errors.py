"""The error of messages of a robot's own topics."""


class MessageError(ValueError):
    """A message that is not what the mapping states: names the topic, the field and the remedy."""
