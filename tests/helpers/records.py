"""Records told from each other, whatever they hold."""

from dataclasses import fields

import numpy as np

from codetr_ros.records import TOPICS, Metrics, Record

TIMES = ('_seconds',)
"""What the names of metrics end with that state how long something took."""


def content(record: Record) -> tuple:
    """What a record holds, as a value that equals that of any record that holds the same bits.
    Times that something took are left out.
    """
    if isinstance(record, Metrics):
        values = zip(record.names, record.values.tolist(), strict=True)
        kept = sorted((n, repr(v)) for n, v in values if not n.endswith(TIMES))
        return ('metrics', record.role, record.node, record.phase, record.step, *kept)
    held = [getattr(record, field.name) for field in fields(record)]
    return (
        TOPICS[type(record)],
        *(
            (str(value.dtype), value.shape, value.tobytes())
            if isinstance(value, np.ndarray)
            else repr(value)
            for value in held
        ),
    )
