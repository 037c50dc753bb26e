"""The editor: a page in the browser where a person poses cages and sees the scene follow."""
# `document` is what is edited. It never changes: each command makes a new one (`commands`), so that undo can keep the
# old ones (`history`). A `session` holds the newest one, saves it, and tells listeners. `scene` and `renderer` make
# pictures of it, `server` and `clients` bring them to pages. `page/` is modules as they are, without a build step.
