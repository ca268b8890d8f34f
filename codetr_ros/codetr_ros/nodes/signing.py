"""Signatures of messages, with a key that the nodes of a run share.

`codetr train` and the launch file make a key for each run and hand it to their nodes in an
environment variable: never on a command line, in a log, a file or a bag. Who has it can publish
as any node of the run; nothing is encrypted. Who controls a host can read the key of its
processes.
"""

import hashlib
import hmac
import os
import secrets
from collections.abc import Mapping

from codetr_ros.bags.definitions import SIGNATURE_BYTES
from codetr_ros.nodes.errors import NodeError

VARIABLE = 'CODETR_RUN_KEY'
"""The environment variable: 64 hexadecimal digits."""
_KEY_BYTES = 32
_TOKEN_BYTES = 8
_PADDING = 4  # the middleware may append zeros up to a multiple of this


def new_key() -> str:
    """A new key, as the environment variable has it."""
    return secrets.token_bytes(_KEY_BYTES).hex()


def environment(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The variable with the key of a run: what is there, so that a node beside those that are
    started can be handed the same, or else a new one.
    """
    return {VARIABLE: environ.get(VARIABLE) or new_key()}


def key_of(environ: Mapping[str, str] = os.environ) -> bytes | None:
    """The key of the run; None if there is none.

    Raises:
        NodeError: the variable is no key. Its value is not shown.
    """
    text = environ.get(VARIABLE, '')
    if not text:
        return None
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b''
    if len(key) != _KEY_BYTES:
        raise NodeError(
            f'environment variable {VARIABLE} must be {2 * _KEY_BYTES} hexadecimal digits, and it '
            f'has {len(text)} characters: hand over what the other nodes of the run have, or '
            'unset it in all of them'
        )
    return key


def signature(key: bytes, topic: str, data: bytes) -> bytes:
    """The signature of a message.

    Args:
        key: that of the run.
        topic: full name of the topic.
        data: CDR bytes before the signature.
    """
    return hashlib.blake2b(
        topic.encode() + b'\0' + data, key=key, digest_size=SIGNATURE_BYTES
    ).digest()


def signed(key: bytes, topic: str, data: bytes) -> bytes:
    """A message with its signature.

    Args:
        key: that of the run.
        topic: full name of the topic.
        data: CDR bytes of the whole message, which is not signed yet.
    """
    before = data[:-SIGNATURE_BYTES]
    return before + signature(key, topic, before)


def is_signed(key: bytes, topic: str, data: bytes) -> bool:
    """Whether a message that arrived is signed with this key, for this topic."""
    for padding in range(_PADDING):
        end = len(data) - padding
        if padding and data[end]:
            return False
        if end < SIGNATURE_BYTES:
            return False
        start = end - SIGNATURE_BYTES
        if hmac.compare_digest(signature(key, topic, data[:start]), data[start:end]):
            return True
    return False


def is_keyed(data: bytes) -> bool:
    """Whether whoever published a message has a key: it bears a signature at all."""
    return any(data[-SIGNATURE_BYTES:])


def token(key: bytes | None, namespace: str) -> str:
    """What a caller of the services for scorers must name: it lets them score in one run, and is
    no help in signing messages.

    Args:
        key: that of the run; None: the run has none, and the token is empty.
        namespace: that of the run.
    """
    if key is None:
        return ''
    text = f'scores by service\0{namespace}'.encode()
    return hashlib.blake2b(text, key=key, digest_size=_TOKEN_BYTES).hexdigest()
