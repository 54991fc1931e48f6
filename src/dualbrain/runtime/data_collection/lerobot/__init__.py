"""LeRobotDataset v3 from recorded runs: frames, features, statistics, tables, and the writer of the folder."""
