"""Maps of surfaces of genus 1 to flat tori."""
