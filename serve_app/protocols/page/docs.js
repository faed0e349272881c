// Addresses are relative, so that the page also works behind a route prefix.
// No validator badge: it would contact validator.swagger.io.
SwaggerUIBundle({
  url: "openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout",
});
