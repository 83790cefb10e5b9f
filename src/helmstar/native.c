/* Which sources this library was made of; helmstar/native.py opens no other. */
#include <stdint.h>

uint32_t helmstar_sources(void) { return HELMSTAR_SOURCES; }
