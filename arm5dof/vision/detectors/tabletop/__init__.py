"""The detector that ships: objects of the catalogue on a table."""
