from dataclasses import fields

import pytest

from codetr_ros.records import TOPICS


@pytest.mark.parametrize('kind', TOPICS, ids=lambda kind: kind.__name__)
def test_the_fields_of_a_record_are_given_by_name_so_that_none_can_be_swapped(kind):
    values = {f.name: number for number, f in enumerate(fields(kind))}
    assert kind(**values).run_id == 0
    with pytest.raises(TypeError, match='positional'):
        kind(*values.values())
