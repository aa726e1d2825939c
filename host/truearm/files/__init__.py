"""Files that users give and get: observation tables, rigs, robots, results. Strangers' files are checked here."""
