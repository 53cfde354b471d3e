"""``python -m trajectron_service`` is ``trajectron``."""

from trajectron_service.cli import main

if __name__ == "__main__":
    main()
