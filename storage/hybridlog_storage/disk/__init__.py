"""Files and directories: durability, guards, locks, temporary names. Imports: segments."""
