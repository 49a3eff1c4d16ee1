"""What the programs print: tables, numbers and documents, for people and for other programs."""
