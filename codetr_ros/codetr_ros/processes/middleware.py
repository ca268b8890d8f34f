"""How processes of a run set up the middleware unless the user says otherwise."""

DEFAULTS: dict[str, str] = {
    # Only this host is looked at unless the user asks for more.
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    # Asynchronous publication adds a thread and a copy, and orders nothing better.
    'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS',
}
"""Environment variables; those that are set stay as they are."""
