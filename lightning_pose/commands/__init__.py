"""One thin module a verb outside Lightning's command line: read the arguments, call, print."""
