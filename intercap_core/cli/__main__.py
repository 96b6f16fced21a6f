"""``python -m intercap_core.cli``."""

from intercap_core.cli.main import main

main()
