"""The ceilvod command as installed: what is imported is not searched for garbage, then or later."""

import gc
from typing import NoReturn


def entry() -> NoReturn:
    """Run the command; a robot that restarts is there a tenth sooner."""
    gc.disable()
    from ceilvo.daemon import cli

    gc.freeze()
    gc.enable()
    cli.entry()
