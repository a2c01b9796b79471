"""One module per kind of file: typed readers and writers. Each convention lives in one place."""
