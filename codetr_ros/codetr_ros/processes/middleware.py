"""The middleware settings of the processes of a run, unless the user sets others."""

DEFAULTS: dict[str, str] = {
    # Discover nodes on this host only, unless the user asks for more.
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    # Asynchronous publication adds a thread and a copy, and no better order.
    'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS',
}
"""Environment variables; those already set keep their values."""
