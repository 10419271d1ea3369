"""Tables, findings and figures of the paper; nothing else imports this package but recipes and tests."""
