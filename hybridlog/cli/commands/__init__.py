"""The commands: each lies in the file with its name, and imports what the folder above shares."""
