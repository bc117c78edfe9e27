"""Running methods over walks: errors, figures, intervals, leaderboard, sweep."""
