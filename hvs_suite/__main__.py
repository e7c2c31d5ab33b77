"""``python -m hvs_suite`` is the command ``hvs``."""

from hvs_suite.cli.main import main

if __name__ == "__main__":
    main()
