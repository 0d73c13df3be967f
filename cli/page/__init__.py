"""The live page: its server, its contents, and its commands to a virtual board."""
