"""The scripts of the Redis store: each runs alone on the server.

Keys, all with one hash tag so that they share a slot: a hash per session (``revision``,
``expires_at``, ``data``); sorted sets of all sessions by expiry, of a tenant's ids, of closures by
time, of unreadable sessions by time; a string per closure and per unreadable session. A member of
a sorted set is the session's tenant and id with a slash between (neither has one).
"""

from __future__ import annotations

CREATE = """
local stored = redis.call('HGET', KEYS[1], 'revision')
if stored then
  return stored == ARGV[1] and 'created' or 'taken'
end
if redis.call('ZCARD', KEYS[2]) >= tonumber(ARGV[6]) then return 'full' end
if ARGV[7] ~= '' and redis.call('ZCARD', KEYS[3]) >= tonumber(ARGV[7]) then
  return 'tenant_full'
end
redis.call('HSET', KEYS[1], 'revision', ARGV[1], 'expires_at', ARGV[2], 'data', ARGV[3])
redis.call('ZADD', KEYS[2], ARGV[2], ARGV[4])
redis.call('ZADD', KEYS[3], 0, ARGV[5])
return 'created'
"""

WRITE = """
local stored = redis.call('HGET', KEYS[1], 'revision')
if stored ~= ARGV[5] and stored ~= ARGV[1] then return 0 end
redis.call('HSET', KEYS[1], 'revision', ARGV[1], 'expires_at', ARGV[2], 'data', ARGV[3])
redis.call('ZADD', KEYS[2], ARGV[2], ARGV[4])
return 1
"""

TOUCH = """
if redis.call('EXISTS', KEYS[1]) == 0 then return 0 end
redis.call('HSET', KEYS[1], 'expires_at', ARGV[1])
redis.call('ZADD', KEYS[2], ARGV[1], ARGV[2])
return 1
"""

# KEYS: session, expiries, ids, closure, closures. ARGV: expired_by or '', revision or '', member,
# id, closure, at, seconds and number of closures kept, the closures' prefix, then for a
# quarantine: its key, its index, the number kept (the key of the bytes is the member there).
REMOVE = """
local stored = redis.call('HMGET', KEYS[1], 'revision', 'expires_at', 'data')
if not stored[1] or (ARGV[2] ~= '' and stored[1] ~= ARGV[2]) then
  return redis.call('GET', KEYS[4]) == ARGV[5] and 1 or 0
end
if ARGV[1] ~= '' and tonumber(stored[2]) > tonumber(ARGV[1]) then return 0 end
redis.call('DEL', KEYS[1])
redis.call('ZREM', KEYS[2], ARGV[3])
redis.call('ZREM', KEYS[3], ARGV[4])
redis.call('SET', KEYS[4], ARGV[5], 'EX', ARGV[7])
redis.call('ZADD', KEYS[5], ARGV[6], ARGV[3])
redis.call('ZREMRANGEBYSCORE', KEYS[5], '-inf', tonumber(ARGV[6]) - tonumber(ARGV[7]))
local over = redis.call('ZCARD', KEYS[5]) - tonumber(ARGV[8])
if over > 0 then
  local oldest = redis.call('ZPOPMIN', KEYS[5], over)
  for i = 1, #oldest, 2 do redis.call('DEL', ARGV[9] .. oldest[i]) end
end
if KEYS[6] then
  redis.call('SET', KEYS[6], stored[3])
  redis.call('ZADD', KEYS[7], ARGV[6], KEYS[6])
  over = redis.call('ZCARD', KEYS[7]) - tonumber(ARGV[10])
  if over > 0 then
    local oldest = redis.call('ZPOPMIN', KEYS[7], over)
    for i = 1, #oldest, 2 do redis.call('DEL', oldest[i]) end
  end
end
return 1
"""
