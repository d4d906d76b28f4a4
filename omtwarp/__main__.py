"""``python -m omtwarp``."""

from omtwarp.cli import main

if __name__ == "__main__":
    main()
