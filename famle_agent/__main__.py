"""``python -m famle_agent`` is ``famle``."""

from famle_agent.app.cli import main

if __name__ == "__main__":
    main()
