/* device.xml and what SFNC 1 calls it, as build.py turns them into bytes. */
#ifndef DESCRIPTION_H
#define DESCRIPTION_H

#include <stddef.h>
#include <stdint.h>

extern const uint8_t description[], legacy_description[];
extern const size_t description_size, legacy_description_size;

#endif
