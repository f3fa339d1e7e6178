"""orbax, imported without the handler that it leaves on Python's root logger: a user's own logging is to be heard."""

import logging

_handlers = logging.root.handlers[:]
import orbax.checkpoint as ocp  # noqa: E402

logging.root.handlers[:] = _handlers

__all__ = ["ocp"]
