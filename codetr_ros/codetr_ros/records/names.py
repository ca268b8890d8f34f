"""Names of topics and types, in the one form in which they are compared."""


def full_name(topic: str) -> str:
    """A topic with its leading slash: writers through an API name topics as they were given."""
    return topic if topic.startswith('/') else f'/{topic}'


def full_type_name(name: str) -> str:
    """`package/msg/Name`, where some writers have `package/Name`."""
    package, _, rest = name.partition('/')
    return f'{package}/msg/{rest}' if rest and '/' not in rest else name
