#!/bin/sh
# One Ray node whose control lives on in Redis, and deploy/serve.yaml's application on it. Everything but port 8000
# listens on loopback. SIGTERM ends it: `ray start --block` stops Ray.
set -eu
config="${1:?server.sh needs the configuration to deploy, as deploy/compose/serve.yaml}"
RAY_AUTH_TOKEN="$(cat "${RAY_AUTH_TOKEN_FILE:?the file of the Ray cluster token}")"
export RAY_AUTH_TOKEN
export RAY_REDIS_ADDRESS="${RLSERVO_REDIS:?HOST:PORT of Redis}"
environment="$(rlservo cluster env --one-machine --haproxy-folder "$HOME/haproxy" --max-connections-per-address 0)"
eval "$environment"
ray start --head --block --node-ip-address 127.0.0.1 --port "${RLSERVO_GCS_PORT:-6379}" \
  --dashboard-host 127.0.0.1 --dashboard-port "${RLSERVO_DASHBOARD_PORT:-8265}" --object-store-memory 80000000 \
  --redis-password "$(cat "${RLSERVO_REDIS_PASSWORD_FILE:?the file of its password}")" &
ray="$!"
trap 'kill -TERM "$ray" 2>/dev/null || true; wait "$ray" || true' TERM INT EXIT
until serve deploy "$config" --address "http://127.0.0.1:${RLSERVO_DASHBOARD_PORT:-8265}"; do
  kill -0 "$ray" # Ray ended: so do we
  sleep 1
done
wait "$ray"
