"""The object cache: crops and boxes of demonstrations, extracted once for all trainings."""
