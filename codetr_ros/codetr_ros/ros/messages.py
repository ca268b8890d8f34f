"""The message classes that carry records. `bags.definitions` turns the bytes of a message into its
record and back, without ROS: nothing that arrives is decoded inside the middleware.
"""

from functools import cache
from typing import Any

import codetr_msgs.msg

from codetr_ros.bags.definitions import own_types
from codetr_ros.records.fields import type_name


@cache
def message_type(record_type: type) -> Any:
    """The message class that carries this kind of record.

    Raises:
        TypeError: the messages were built by another version.
    """
    kind = getattr(codetr_msgs.msg, record_type.__name__)
    built = list(kind.get_fields_and_field_types())
    name = type_name(record_type)
    ours = [field for field, _ in own_types().fielddefs[name][1]]
    if built != ours:
        raise TypeError(
            f'{name} was built with fields {built}, this version has {ours}: build the workspace '
            'again'
        )
    return kind
