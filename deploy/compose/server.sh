#!/bin/sh
# One Ray node whose control lives on in Redis, and a Serve configuration on it: server.sh CONFIG [option of ray start...]
# Everything but the configuration's own ports listens on loopback. SIGTERM ends it, in order.
set -eu
config="${1:?server.sh needs the configuration to deploy, as deploy/compose/serve.yaml}"
shift
RAY_AUTH_TOKEN="$(cat "${RAY_AUTH_TOKEN_FILE:?the file of the Ray cluster token}")"
export RAY_AUTH_TOKEN
export RAY_REDIS_ADDRESS="${RLSERVO_REDIS:?HOST:PORT of Redis}"
environment="$(rlservo cluster env --one-machine --haproxy-folder "$HOME/haproxy" --max-connections-per-address 0)"
eval "$environment"
dashboard="${RLSERVO_DASHBOARD_PORT:-8265}"
# Not `ray start`, whose raylet waits too short for its agents on a busy machine, and aborts. Without what nobody uses
# here: the autoscaler and the log monitor.
python -m rlservo.serve_app.ray_serve.ray_node start --head --block --node-ip-address 127.0.0.1 --dashboard-host 127.0.0.1 --dashboard-port "$dashboard" \
  --object-store-memory 80000000 --disable-usage-stats --no-monitor --include-log-monitor false \
  --redis-password "$(cat "${RLSERVO_REDIS_PASSWORD_FILE:?the file of its password}")" "$@" &
ray="$!"
trap 'kill -TERM "$ray" 2>/dev/null || true; wait "$ray" || true' TERM INT EXIT
healthy="import urllib.request as u; u.urlopen('http://127.0.0.1:$dashboard/api/gcs_healthz', timeout=5)"
until python -c "$healthy" 2>/dev/null && serve deploy "$config" --address "http://127.0.0.1:$dashboard"; do
  kill -0 "$ray" # Ray ended: so do we
  echo "server.sh: Ray is not ready yet" >&2
  sleep 2
done
wait "$ray"
