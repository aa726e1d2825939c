"""Files that users supply and receive: observation tables, rigs, robots, results. External files are checked here."""
