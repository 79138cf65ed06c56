"""`python -m hybridlog`."""

from hybridlog.cli import main

if __name__ == "__main__":
    main()
