"""Keys of robots: Ed25519, a private one in a file on the robot, the public ones with the service."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from ceilvo.errors import CeilvoError, ConfigError
from ceilvo.files import read_secret

KEY_BYTES, SIGNATURE_BYTES = 32, 64
_MOST_BYTES = 200
_MAKE_ONE = "make one with: ceilvod map key FILE"


@dataclass(frozen=True)
class Signer:
    """A robot's key.

    Attributes:
        public: (32 bytes) what the service knows it by.
    """

    _private: Ed25519PrivateKey
    public: bytes

    @staticmethod
    def of(private: bytes) -> Signer:
        """From 32 bytes."""
        key = Ed25519PrivateKey.from_private_bytes(private)
        return Signer(key, key.public_key().public_bytes_raw())

    @staticmethod
    def read(path: Path) -> Signer:
        """From a file.

        Raises:
            ConfigError: it holds no key, or others may read it.
        """
        name = "fleet.key_file"
        text = read_secret(path, name, "a robot's key", _MOST_BYTES, _MAKE_ONE, "make a new one")
        try:
            return Signer.of(_from_hex(text.decode("ascii")))
        except (UnicodeDecodeError, ValueError) as e:
            raise ConfigError(
                f"{name}: {path} holds no key, expected {2 * KEY_BYTES} hexadecimal digits; {_MAKE_ONE}"
            ) from e

    def sign(self, message: bytes) -> bytes:
        return self._private.sign(message)


def make(path: Path) -> Signer:
    """A new key into a new file that nobody else may read.

    Raises:
        CeilvoError: there is one already, or it cannot be written.
    """
    private = Ed25519PrivateKey.generate().private_bytes_raw()
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as f:
            f.write(private.hex().encode() + b"\n")
            f.flush()
            os.fsync(f.fileno())
    except FileExistsError as e:
        raise CeilvoError(
            f"{path}: is there already, expected a new name; 'ceilvod map key' shows what is in it"
        ) from e
    except OSError as e:
        raise CeilvoError(f"{path}: cannot be written: {e.strerror}; check its folder and its owner") from e
    return Signer.of(private)


def is_signed(public: bytes, signature: bytes, message: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def public_of(text: str) -> bytes:
    """A public key as people give it.

    Raises:
        CeilvoError: it is none.
    """
    try:
        return _from_hex(text.strip())
    except ValueError as e:
        raise CeilvoError(
            f"key {text[:80]!r}: expected {2 * KEY_BYTES} hexadecimal digits, as 'ceilvod map key FILE' prints them"
        ) from e


def _from_hex(text: str) -> bytes:
    key = bytes.fromhex(text)
    if len(key) != KEY_BYTES:
        raise ValueError(text)
    return key
