"""The one configuration of a run: typed, validated, and the source of CLI flags, YAML keys and ROS
parameters.
"""

from codetr_ros.config.base import (
    Group,
    SettingsError,
    explain,
    flatten,
    in_words,
    names,
    validate,
)
from codetr_ros.config.choices import IN_PROCESS_ONLY, SCORE_LEARNERS, Composite, Method
from codetr_ros.config.delays import Delay, Lengths, delay_in_words
from codetr_ros.config.loading import (
    PRESETS,
    differences,
    from_canonical,
    load,
    nearest,
    parse,
)
from codetr_ros.config.methods import (
    AggregateSettings,
    CodetrSettings,
    DiasterSettings,
    HcSettings,
    LirpgSettings,
    LrrSettings,
    MilLstmSettings,
    MlpSettings,
    PerceptronSettings,
    RbtSettings,
    RrdSettings,
    SacSettings,
)
from codetr_ros.config.people import PeopleSettings
from codetr_ros.config.run import Settings
from codetr_ros.config.threads import settled
from codetr_ros.config.usual import USUAL, from_text

__all__ = [
    'IN_PROCESS_ONLY',
    'PRESETS',
    'SCORE_LEARNERS',
    'USUAL',
    'AggregateSettings',
    'CodetrSettings',
    'Composite',
    'Delay',
    'DiasterSettings',
    'Group',
    'HcSettings',
    'Lengths',
    'LirpgSettings',
    'LrrSettings',
    'Method',
    'MilLstmSettings',
    'MlpSettings',
    'PeopleSettings',
    'PerceptronSettings',
    'RbtSettings',
    'RrdSettings',
    'SacSettings',
    'Settings',
    'SettingsError',
    'delay_in_words',
    'differences',
    'explain',
    'flatten',
    'from_canonical',
    'from_text',
    'in_words',
    'load',
    'names',
    'nearest',
    'parse',
    'settled',
    'validate',
]
