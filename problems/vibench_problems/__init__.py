"""The problems that vibench ships, registered through the entry points any other package would use."""
